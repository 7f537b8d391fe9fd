"""The commands: `python -m runners.NAME`."""

import sys

if sys.argv[:1] == ["-m"]:  # while Python looks for the command, and before all of its imports
    from replay.startup import begin
    from runners.command_help import help_at_once

    begin()
    help_at_once()
