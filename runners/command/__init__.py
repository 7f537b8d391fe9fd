"""The parts that commands share: arguments, choices, help, errors in one line, and scripts."""
