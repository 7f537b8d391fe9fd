"""What all commands share: their arguments, choices and help, errors in one line, and scripts."""
