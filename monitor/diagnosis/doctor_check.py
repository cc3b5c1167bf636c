"""The result of one check of the machine, with what to do about it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

DoctorVerdict = Literal["ok", "warning", "failed"]
VERDICTS: tuple[DoctorVerdict, ...] = ("ok", "warning", "failed")


@dataclass(frozen=True, slots=True)
class DoctorCheck:
    """The result of one check.

    Parameters
    ----------
    name : str
        What was checked.
    verdict : {"ok", "warning", "failed"}
        ``failed``: the monitor will not run, or not here; ``warning``: it will, with less than it could have.
    found : str
        The result, for people.
    advice : str
        What to do about it; empty where nothing is to be done.
    """

    name: str
    verdict: DoctorVerdict
    found: str
    advice: str = ""
