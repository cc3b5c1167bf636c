"""A condition of a flight that is no fault: its kind, its begin and its sizes."""

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal


@dataclass(frozen=True, slots=True)
class FlightCondition:
    """A condition of a flight; it raises no alarm."""

    name: Literal["payload", "wind", "pressure"]
    since_ns: int  # Unix time
    text: str  # a sentence for a person
    values: Mapping[str, float]  # sizes by name; their units are in the names

    def to_json(self) -> dict[str, Any]:
        """Return the condition as it stands in the status and in the output of ``--json``."""
        return {**asdict(self), "kind": "information"}


def latest_conditions(found: Iterable[FlightCondition]) -> list[FlightCondition]:
    """Return the last condition of each name."""
    return list({condition.name: condition for condition in found}.values())
