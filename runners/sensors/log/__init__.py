"""Logs of robots: from the bytes of files to messages at times that can be compared."""
