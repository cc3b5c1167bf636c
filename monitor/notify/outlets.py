"""Outlets of notices: services that Apprise supports, and the user's own programs."""

import logging
import os
import signal
import stat
import subprocess
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

from adapters.errors import UsageError
from monitor.bus.payload import to_json
from monitor.notify.notices import Notice, summary

_MAX_FILE_BYTES = 65_536
"""Largest size of a file of URLs, bytes. Chosen: far more than so many URLs take."""
_MAX_SERVICES = 20
"""Largest number of services. Chosen: each has a thread of its own."""
_MAX_ERROR = 200
"""Letters of a failed program's output that are kept. Chosen: a line of a log."""


class DeliveryError(Exception):
    """A notice could not be delivered; it is tried again."""


class Outlet(Protocol):
    """Delivers notices; may take its time."""

    name: str

    def send(self, notices: Sequence[Notice]) -> None:
        """Deliver notices, several as one message; raise DeliveryError if that fails."""


class AppriseOutlet:
    """One service, by its Apprise URL; the URL is a secret and appears in no message."""

    def __init__(self, url: str, index: int) -> None:
        import apprise

        # Apprise logs the text of messages, and URLs
        logging.getLogger("apprise").setLevel(logging.CRITICAL)
        with warnings.catch_warnings():
            # of modules that its hundred plug-ins import
            warnings.simplefilter("ignore", DeprecationWarning)
            service = apprise.Apprise.instantiate(url, suppress_exceptions=True)
        if service is None:
            kind = url.partition(":")[0] if "://" in url else "no URL"
            raise UsageError(f"line {index} ({kind}) is no service that Apprise knows, or not complete")
        self._service = service
        self.name = f"{url.partition(':')[0].lower()}-{index}"

    def send(self, notices: Sequence[Notice]) -> None:
        """Deliver notices."""
        import apprise

        occasions = {notice.occasion for notice in notices}
        kind = apprise.NotifyType.WARNING
        if occasions & {"critical", "blind"}:
            kind = apprise.NotifyType.FAILURE
        elif occasions == {"cleared"}:
            kind = apprise.NotifyType.SUCCESS
        title, body = summary(notices)
        if not self._service.notify(title=title, body=body, notify_type=kind):
            raise DeliveryError("the service refused it")


class ExecOutlet:
    """A program, started without a shell, that gets a JSON object per event on its standard input, one on each line."""

    name = "exec"

    def __init__(self, command: Sequence[str], timeout_s: float) -> None:
        self._command = list(command)
        self._timeout_s = timeout_s

    def send(self, notices: Sequence[Notice]) -> None:
        """Run the program once for all notices."""
        lines = b"".join(to_json({"occasion": notice.occasion, **notice.event.to_json()}) + b"\n" for notice in notices)
        # systemd would mistake the program's notifications for the daemon's own
        environment = {key: value for key, value in os.environ.items() if key not in ("NOTIFY_SOCKET", "WATCHDOG_USEC")}
        try:
            process = subprocess.Popen(  # noqa: S603 - the program that the configuration names
                self._command,
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                env=environment,
                start_new_session=True,
            )
        except OSError as error:
            raise DeliveryError(f"{self._command[0]}: {error.strerror}") from error
        with process:
            try:
                _, said = process.communicate(lines, timeout=self._timeout_s)
            except subprocess.TimeoutExpired:
                # and the processes that it has started
                os.killpg(process.pid, signal.SIGKILL)
                raise DeliveryError(f"{self._command[0]} took longer than {self._timeout_s:g} s") from None
        if process.returncode:
            words = said.decode(errors="replace").strip()[:_MAX_ERROR]
            raise DeliveryError(f"{self._command[0]} ended with {process.returncode}{f': {words}' if words else ''}")


def make_outlets(urls_file: Path | None, command: Sequence[str], timeout_s: float) -> list[Outlet]:
    """Return the outlets of a configuration. ``urls_file`` holds one Apprise URL on each line.

    Raises UsageError if Apprise is not installed, or the file cannot be read, may be read by others, or names no
    service.
    """
    outlets: list[Outlet] = []
    if urls_file is not None:
        urls = _read_urls(urls_file)
        try:
            import apprise  # noqa: F401 - asked for before the first URL is made
        except ImportError as error:
            raise UsageError(
                f"{urls_file}: apprise is not installed, which sends to such URLs; run: pip install 'fauio[notify]'"
            ) from error
        for index, url in urls:
            try:
                outlets.append(AppriseOutlet(url, index))
            except UsageError as error:
                raise UsageError(f"{urls_file}: {error}; see https://appriseit.com/services/") from error
    return [*outlets, *([ExecOutlet(command, timeout_s)] if command else [])]


def _read_urls(path: Path) -> list[tuple[int, str]]:
    """Return URLs with their line numbers, without blank lines and comments (#)."""
    try:
        with path.open("rb") as file:
            mode = os.fstat(file.fileno()).st_mode
            content = file.read(_MAX_FILE_BYTES + 1)
    except OSError as error:
        raise UsageError(f"{path}: cannot be read: {error.strerror}") from error
    if mode & (stat.S_IROTH | stat.S_IWOTH):
        raise UsageError(
            f"{path}: every user may read or change these URLs, which hold secrets; run 'chmod o-rwx {path}'"
        )
    lines = enumerate(content.decode(errors="replace").splitlines(), 1)
    urls = [(index, text) for index, line in lines if (text := line.strip()) and not text.startswith("#")]
    if not urls or len(urls) > _MAX_SERVICES or len(content) > _MAX_FILE_BYTES:
        raise UsageError(f"{path}: has {len(urls)} URLs; give one a line, {_MAX_SERVICES} at most")
    return urls
