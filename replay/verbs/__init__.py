"""What can be done with a recording: a module a verb, each with add_arguments and run."""

from __future__ import annotations

VERBS = {
    "info": "what is in a recording",
    "verify": "run registrations again and compare every bit",
    "step": "run one registration again, with another method or other settings",
    "compare": "run several methods on the same recorded problems",
    "diff": "how two recordings differ",
    "view": "make the Rerun recording anew and open it",
    "recover": "save what is whole of a damaged or unfinished recording",
    "export": "points, hypotheses, archives or numbers as npz, csv or json",
    "bless": "record today's results as the expected ones",
}
