"""The commands: `python -m runners.NAME`, or `chsel-NAME` where they are installed."""

import sys

if sys.argv[:1] == ["-m"]:  # while Python looks for the command, and before all of its imports
    from replay.startup import begin
    from runners.command.at_once import answer_at_once

    begin()
    _words = sys.orig_argv
    _module = _words[_words.index("-m") + 1] if "-m" in _words else ""
    if _module.startswith("runners."):
        answer_at_once(_module.removeprefix("runners."), installed=False)
