"""Checks of ``fauio doctor`` about the machine: folders, disk, serial devices, receive buffers, the clock."""

import ctypes
import os
import shutil
import struct
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from adapters.mavlink.byte_link import UDP_BUFFER_BYTES
from monitor.diagnosis.doctor import DoctorCheck, DoctorVerdict

_LITTLE_BYTES = 2_000_000_000
"""Free bytes below which a warning is given: five hours of a vehicle's recording at 400 MB an hour
(docs/operations.md)."""
_TOO_LITTLE_BYTES = 100_000_000
"""Free bytes below which the check fails: a quarter of an hour of recording, so a flight may end without one."""
_RECEIVE_LIMIT = Path("/proc/sys/net/core/rmem_max")
_SYNCHRONISED = Path("/run/systemd/timesync/synchronized")
_SERIAL_PATTERNS = ("ttyUSB*", "ttyACM*", "ttyAMA*")
_COMPARE_S = 0.05
"""Seconds for which clocks are compared. Chosen: long enough that the setting of a clock exceeds the milliseconds of
the scheduler."""
_LARGEST_DRIFT = 0.05
"""Largest drift of the clock, as a share of the time compared. NTP slews by .05 % at most; a clock that is a hundred
times as fast is being set."""
# A clock that was never set shows the year 1970, or the year in which its system was built.
_EARLIEST_S = 1_735_689_600
# adjtimex(2): modes, offset, freq, maxerror, esterror, status, and more
_TIMEX = struct.Struct("@I4li")
_TIMEX_BYTES = 512
_STA_UNSYNC = 0x40
_TIME_ERROR = 5


def folder_check(folder: Path) -> DoctorCheck:
    """Check that files can be made in a folder, or that the folder itself can be made."""
    name = "folder"
    place = _existing(folder)
    advice = f"sudo chown $USER {place}, or name another folder"
    if not place.is_dir():
        return DoctorCheck(name, "failed", f"{folder}: {place} is no folder", "name another folder")
    try:
        with tempfile.NamedTemporaryFile(dir=place):
            pass
    except OSError as error:
        return DoctorCheck(name, "failed", f"{folder}: cannot be written: {error.strerror}", advice)
    where = "can be written" if place == folder else f"can be made in {place}"
    return DoctorCheck(name, "ok", f"{folder.absolute()} {where}")


def disk_check(folder: Path) -> DoctorCheck:
    """Check the room on a folder's disk."""
    try:
        free = shutil.disk_usage(_existing(folder)).free
    except OSError as error:
        return DoctorCheck("disk", "failed", f"{folder}: {error.strerror}", "name another folder")
    state = f"{free / 1e9:.1f} GB free at {folder.absolute()}"
    if free < _TOO_LITTLE_BYTES:
        return DoctorCheck("disk", "failed", state, "make room: neither journal nor recordings will fit")
    if free < _LITTLE_BYTES:
        return DoctorCheck("disk", "warning", state, "make room, or lower budget_mb: an hour of a vehicle takes 400 MB")
    return DoctorCheck("disk", "ok", state)


def serial_checks(urls: Sequence[str], devices: Path = Path("/dev")) -> list[DoctorCheck]:
    """Check that serial devices can be read: those of links; without any, all that look like an autopilot's."""
    name = "serial device"
    wanted = [Path(url.split(":")[1]) for url in urls]
    ports = wanted or sorted(path for pattern in _SERIAL_PATTERNS for path in devices.glob(pattern))
    if not ports:
        return [DoctorCheck(name, "ok", "none connected")]
    checks = []
    for device in ports:
        if not device.exists():
            checks.append(
                DoctorCheck(name, "failed", f"{device} does not exist", "connect it, or mend the URL of the link")
            )
        elif os.access(device, os.R_OK | os.W_OK):
            checks.append(DoctorCheck(name, "ok", f"{device} can be read"))
        else:
            advice = "sudo usermod -aG dialout $USER, then log in again"
            verdict: DoctorVerdict = "failed" if wanted else "warning"
            checks.append(DoctorCheck(name, verdict, f"{device} cannot be read by this user", advice))
    return checks


def buffer_check(limit: Path = _RECEIVE_LIMIT) -> DoctorCheck:
    """Check how large a receive buffer the kernel allows."""
    name = "udp buffer"
    try:
        allowed = int(limit.read_text())
    except (OSError, ValueError):
        return DoctorCheck(name, "ok", "the kernel does not say how large it may be")
    state = f"up to {allowed / 1024:.0f} KiB"
    if allowed >= UDP_BUFFER_BYTES:
        return DoctorCheck(name, "ok", state)
    state += f", the monitor asks for {UDP_BUFFER_BYTES / 1024:.0f} KiB: bursts beyond it are lost while it is busy"
    return DoctorCheck(name, "warning", state, f"sudo sysctl -w net.core.rmem_max={UDP_BUFFER_BYTES}")


def clock_checks() -> list[DoctorCheck]:
    """Check that the clock is set, runs evenly, and is synchronised by NTP, if the system tells."""
    name = "clock"
    walls = time.time()
    started_wall, started = time.time_ns(), time.monotonic_ns()
    time.sleep(_COMPARE_S)
    elapsed_wall, elapsed = time.time_ns() - started_wall, time.monotonic_ns() - started
    if walls < _EARLIEST_S:
        day = time.strftime("%Y-%m-%d", time.gmtime(walls))
        return [DoctorCheck(name, "failed", f"it shows {day}", "set it: alarms and recordings carry its time")]
    checks = []
    if abs(elapsed_wall - elapsed) > _LARGEST_DRIFT * elapsed:
        state = f"it moved {elapsed_wall / 1e6:.1f} ms in {elapsed / 1e6:.1f} ms"
        checks.append(
            DoctorCheck(name, "failed", state, "a time service is correcting it; wait, or look for two time services")
        )
    else:
        checks.append(DoctorCheck(name, "ok", "it runs evenly"))
    return [*checks, _synchronised_check()]


def _synchronised_check() -> DoctorCheck:
    name = "ntp"
    state = _kernel_clock()
    advice = "sudo timedatectl set-ntp true, or install chrony: times of alarms are those of this clock"
    if _SYNCHRONISED.exists() or (state is not None and state[0]):
        error = f", within {state[1] / 1e3:.0f} ms" if state is not None and state[0] else ""
        return DoctorCheck(name, "ok", f"the clock is synchronised{error}")
    if state is None:
        return DoctorCheck(name, "ok", "whether the clock is synchronised cannot be told here")
    return DoctorCheck(name, "warning", "the clock is not synchronised", advice)


def _kernel_clock() -> tuple[bool, int] | None:
    """Return whether the kernel's clock is synchronised, and its largest error in microseconds; None if unknown."""
    if sys.platform != "linux":
        return None
    timex = ctypes.create_string_buffer(_TIMEX_BYTES)
    try:
        state: int = ctypes.CDLL(None, use_errno=True).adjtimex(timex)
    except (OSError, AttributeError):
        return None
    if state < 0:
        return None
    _, _, _, largest_error, _, status = _TIMEX.unpack_from(timex)
    return state != _TIME_ERROR and not status & _STA_UNSYNC, int(largest_error)


def _existing(folder: Path) -> Path:
    """Return a folder, or its nearest parent that exists."""
    place = folder
    while not place.exists() and place != place.parent:
        place = place.parent
    return place
