"""Packets of an onboard computer beside an autopilot: its heartbeat, its load, and its texts.

Logic without clock and socket: the times are given, the packets are returned. A companion has its vehicle's system id,
so that a ground station shows its texts with the vehicle.
"""

from typing import Any

from adapters.mavlink.signing import SigningKey, unix_stamp

COMPANION = 191
"""MAV_COMP_ID_ONBOARD_COMPUTER."""
CHUNK = 50
"""Bytes of a STATUSTEXT; a longer text continues in the next one."""
MAX_CHUNKS = 4
"""Most packets of a text. Chosen: what a ground station shows in a few lines; each packet loads a slow
radio."""
CRITICAL, WARNING, NOTICE = 2, 4, 5
"""MAV_SEVERITY_CRITICAL, _WARNING and _NOTICE."""

_NONE8, _NONE16, _NONE32 = 0xFF, 0x7FFF, 0xFFFFFFFF
"""Largest numbers of their types, which ONBOARD_COMPUTER_STATUS uses for unknown values."""


class Companion:
    """Makes the packets, under the system ids of any number of vehicles; signs them if there is a key.

    ``dialect`` has pymavlink's messages and constants.
    """

    def __init__(self, key: SigningKey | None = None, component: int = COMPANION) -> None:
        from pymavlink.dialects.v20 import ardupilotmega

        self.dialect: Any = ardupilotmega
        self._packer = ardupilotmega.MAVLink(None, 1, component)
        if key is not None:
            self._packer.signing.secret_key = key.secret
            self._packer.signing.sign_outgoing = True
        self._sequences: dict[int, int] = {}
        self._text_id = 0

    def heartbeat(self, system: int, now_ns: int, *, critical: bool) -> bytes:
        """Return a heartbeat; its state is critical if ``critical``, while an alarm is active."""
        names = self.dialect
        state = names.MAV_STATE_CRITICAL if critical else names.MAV_STATE_ACTIVE
        kind = names.MAV_TYPE_ONBOARD_CONTROLLER
        return self.pack(
            system, names.MAVLink_heartbeat_message(kind, names.MAV_AUTOPILOT_INVALID, 0, 0, state, 3), now_ns
        )

    def computer_status(self, system: int, now_ns: int, *, uptime_ms: int, cpu_percent: int, ram_mb: int) -> bytes:
        """Return the computer's status: since when it runs, its load and the memory of the monitor."""
        message = self.dialect.MAVLink_onboard_computer_status_message(
            time_usec=now_ns // 1000,
            uptime=uptime_ms & _NONE32,
            type=0,
            cpu_cores=[_NONE8] * 8,
            cpu_combined=[max(0, min(cpu_percent, 100)), *[_NONE8] * 9],
            gpu_cores=[_NONE8] * 4,
            gpu_combined=[_NONE8] * 10,
            temperature_board=127,
            temperature_core=[127] * 8,
            fan_speed=[_NONE16] * 4,
            ram_usage=ram_mb,
            ram_total=_NONE32,
            storage_type=[_NONE32] * 4,
            storage_usage=[_NONE32] * 4,
            storage_total=[_NONE32] * 4,
            link_type=[_NONE32] * 6,
            link_tx_rate=[_NONE32] * 6,
            link_rx_rate=[_NONE32] * 6,
            link_tx_max=[_NONE32] * 6,
            link_rx_max=[_NONE32] * 6,
        )
        return self.pack(system, message, now_ns)

    def text(self, system: int, severity: int, text: str, now_ns: int) -> list[bytes]:
        """Return a text as one or several packets, cut at 200 bytes; characters beyond ASCII become question marks."""
        data = text.encode("ascii", "replace")[: CHUNK * MAX_CHUNKS]
        chunks = [data[start : start + CHUNK] for start in range(0, len(data), CHUNK)] or [b""]
        number = 0
        if len(chunks) > 1:
            number = self._text_id = self._text_id % 0xFFFF + 1
            # a full chunk says that another follows, which may be empty
            if len(chunks[-1]) == CHUNK and len(chunks) < MAX_CHUNKS:
                chunks.append(b"")
        return [
            self.pack(system, self.dialect.MAVLink_statustext_message(severity, chunk, number, index), now_ns)
            for index, chunk in enumerate(chunks)
        ]

    def pack(self, system: int, message: Any, now_ns: int) -> bytes:
        """Return a pymavlink message as the next packet under a system id, signed at a Unix time."""
        packer = self._packer
        packer.srcSystem, packer.seq = system, self._sequences.get(system, 0)
        packer.signing.timestamp = max(packer.signing.timestamp, unix_stamp(now_ns))
        packet = bytes(message.pack(packer))
        self._sequences[system] = (packer.seq + 1) % 256
        return packet
