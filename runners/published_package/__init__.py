"""The authors' published package `chsel`, in an environment and a process of its own."""
