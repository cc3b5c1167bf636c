"""A vehicle's positions and attitudes in a log, to be shown on a map and in a scene of three dimensions."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adapters.batch import Batch
from monitor.recording.foxglove_records import EARTH_M, PULLED, places
from monitor.trace import Trace

WAY_MESSAGES = ("GPS_RAW_INT", "ATTITUDE")
"""The messages that are read for a way, beside positions with a latitude."""
_TURNS = ("roll", "pitch", "yaw")
# from north, east, down to east, north, up
_ENU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


@dataclass(frozen=True, slots=True)
class Way:
    """A vehicle's way, with Unix times of arrival."""

    unix_ns: NDArray[np.int64]  # (N,)
    places: NDArray[np.float64]  # latitude and longitude, degrees, altitude, metres, as measured by GPS (N, 3)
    attitude_ns: NDArray[np.int64]  # (M,)
    attitude: NDArray[np.float64]  # roll, pitch, yaw (M, 3)

    def metres(self, places: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return positions (N, 3) as metres east, north and up of the first."""
        north, east = np.deg2rad(places[:, :2] - self.places[0, :2]).T * EARTH_M
        return np.column_stack((east * np.cos(np.deg2rad(self.places[0, 0])), north, places[:, 2] - self.places[0, 2]))

    def real(self, traces: Iterable[Trace]) -> NDArray[np.float64]:
        """Return the positions (N, 3) less the estimated fault of GPS, at samples that are evidence."""
        real = self.places.copy()
        for trace in traces:
            if not set(PULLED) <= set(trace.layout.faults) or not len(trace.unix_ns):
                continue
            rows = np.searchsorted(trace.unix_ns, self.unix_ns, "right") - 1
            columns = [trace.layout.faults.index(name) for name in PULLED]
            pulls = np.nan_to_num(trace.isolated[np.maximum(rows, 0)][:, columns])
            pulls *= ((rows >= 0) & trace.armed[np.maximum(rows, 0)])[:, None]
            real[:, :2] -= np.rad2deg(pulls / EARTH_M)
            real[:, 1] -= np.rad2deg(pulls[:, 1] / EARTH_M) * (1.0 / np.cos(np.deg2rad(real[:, 0])) - 1.0)
        return real

    def rotations(self) -> NDArray[np.float64]:
        """Return the directions ahead, right and down in east, north, up (M, 3, 3)."""
        from scipy.spatial.transform import Rotation

        turned = Rotation.from_euler("ZYX", self.attitude[:, ::-1]).as_matrix()
        return np.asarray(_ENU @ turned, np.float64)


def way_of(batches: Iterable[Batch]) -> Way | None:
    """Return the way in a recording, of the sender with the most positions, or None if no sender has one."""
    fixes: dict[int, list[tuple[int, float, float, float]]] = {}
    turns: dict[int, list[NDArray[np.float64]]] = {}
    times: dict[int, list[NDArray[np.int64]]] = {}
    for batch in batches:
        for columns in batch.columns:
            sender = columns.system
            if columns.source.is_telemetry and (columns.name == "GPS_RAW_INT" or "latitude" in columns.fields):
                fixes.setdefault(sender, []).extend(places(columns))
            if columns.name == "ATTITUDE" and columns.fields.keys() >= set(_TURNS):
                turns.setdefault(sender, []).append(np.column_stack([columns.fields[name] for name in _TURNS]))
                times.setdefault(sender, []).append(columns.received_ns)
    most = max(fixes, key=lambda source: len(fixes[source]), default=None)
    if most is None or not fixes[most]:
        return None
    found = sorted(fixes[most])
    attitude = np.concatenate([np.empty((0, 3)), *turns.get(most, [])])
    return Way(
        unix_ns=np.array([at[0] for at in found], np.int64),
        places=np.array([at[1:] for at in found]),
        attitude_ns=np.concatenate([np.empty(0, np.int64), *times.get(most, [])]),
        attitude=attitude,
    )
