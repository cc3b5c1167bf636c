"""The result of one check of the machine, with what to do about it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

DoctorVerdict = Literal["ok", "warning", "failed"]
VERDICTS: tuple[DoctorVerdict, ...] = ("ok", "warning", "failed")


@dataclass(frozen=True, slots=True)
class DoctorCheck:
    """The result of one check."""

    name: str
    # ``failed``: the monitor will not run, or not here; ``warning``: it will, with less than it could have
    verdict: DoctorVerdict
    found: str
    advice: str = ""  # what to do about it; empty where nothing is to be done
