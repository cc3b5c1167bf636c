"""Operators' commands over Zenoh: queries on ``<root>/command/<verb>``, answered with their effect or a refusal.

Queries come on Zenoh's threads and wait in a bounded queue until the monitor's own thread has carried them out.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection
from typing import TYPE_CHECKING, Any, NamedTuple

from adapters.errors import printable
from adapters.message import Message
from adapters.source import OPERATOR
from monitor.bus.payload import decode_payload, to_json

if TYPE_CHECKING:
    import zenoh

    from monitor.event import AlarmEvent

VERBS = ("ack", "shelve", "unshelve", "reset")
_WAITING = 64
"""Most commands that wait for the loop. Chosen: more than people send in the milliseconds until an answer."""
_MAX_BYTES = 4096
"""Most bytes of a command. Chosen: a channel, a name and a comment have some hundreds."""
_MAX_TEXT = 200
"""Most letters of an operator's name or comment. Chosen: two lines of a table."""
_MINUTE_NS = 60_000_000_000


class Command(NamedTuple):
    """A command that waits for its answer."""

    verb: str
    fields: dict[str, Any]
    query: Any


class Operators:
    """The commands of one vehicle; only those with an allowed verb are carried out.

    An alarm is shelved for ``shelve_minutes`` if the command does not say for how long, and for ``max_shelve_minutes``
    at most. The session is left open by :meth:`close`.
    """

    def __init__(
        self,
        session: zenoh.Session,
        root: str,
        allowed: Collection[str],
        shelve_minutes: float = 60.0,
        max_shelve_minutes: float = 480.0,
    ) -> None:
        self._root = root
        self._allowed = frozenset(allowed)
        self._shelve_minutes = shelve_minutes
        self._max_shelve_minutes = max_shelve_minutes
        self._waiting: deque[Command] = deque()
        self.refused = 0
        self._queryable: Any = session.declare_queryable(f"{root}/command/*", self._on_query, complete=True)

    def pending(self) -> list[Command]:
        """Return the commands that came since the last call; each has to be answered."""
        return [self._waiting.popleft() for _ in range(len(self._waiting))]

    def message(self, command: Command, now_ns: int) -> Message:
        """Return a command in the pipeline's form, with the time at which shelving ends."""
        fields = dict(command.fields)
        if command.verb == "shelve":
            minutes = fields.pop("minutes", None)
            given = isinstance(minutes, int | float) and not isinstance(minutes, bool) and minutes > 0
            # Compared before anything is computed: a whole number may be too large for a float.
            chosen = min(minutes, self._max_shelve_minutes) if given else self._shelve_minutes
            fields["until_ns"] = now_ns + round(chosen * _MINUTE_NS)
        return Message(OPERATOR, command.verb, now_ns, fields)

    def accept(self, command: Command, event: AlarmEvent | None) -> None:
        """Answer a command that was carried out, with the event it caused, if any."""
        import zenoh

        answer = to_json({"ok": True, "event": None if event is None else event.to_json()})
        with command.query:
            key = f"{self._root}/command/{command.verb}"
            command.query.reply(key, answer, encoding=zenoh.Encoding.APPLICATION_JSON)

    def refuse(self, command: Command, reason: str) -> None:
        """Answer a command that was not carried out."""
        self.refused += 1
        with command.query:
            command.query.reply_err(to_json({"ok": False, "error": reason}))

    def close(self) -> None:
        """Refuse the commands that wait, and all later ones."""
        self._queryable.undeclare()
        for command in self.pending():
            self.refuse(command, "the monitor is stopping")

    def _on_query(self, query: zenoh.Query) -> None:
        verb = str(query.key_expr).rsplit("/", 1)[-1]
        command = Command(verb, {}, query)
        if verb not in VERBS:
            self.refuse(command, f"'{verb}' is no command; commands are {', '.join(VERBS)}")
        elif verb not in self._allowed:
            self.refuse(command, f"'{verb}' is not allowed here; the monitor's config names it in [commands] allow")
        elif len(self._waiting) >= _WAITING:
            self.refuse(command, "too many commands at once; try again")
        elif (fields := _fields(query)) is None:
            self.refuse(command, "the payload is no JSON object with the 'id' or the 'channel' of an alarm")
        else:
            self._waiting.append(command._replace(fields=fields))


def _fields(query: zenoh.Query) -> dict[str, Any] | None:
    """Return the known keys of a command's payload, or None if it is no command."""
    request = None if query.payload is None or len(query.payload) > _MAX_BYTES else decode_payload(query.payload)
    if not isinstance(request, dict):
        return None
    # Texts are shown on terminals, in logs and in a database: unprintable characters are removed here.
    fields: dict[str, Any] = {
        key: printable(value[:_MAX_TEXT])
        for key in ("id", "channel", "by", "reason")
        if isinstance(value := request.get(key), str)
    }
    if isinstance(request.get("minutes"), int | float):
        fields["minutes"] = request["minutes"]
    return fields if "id" in fields or "channel" in fields else None
