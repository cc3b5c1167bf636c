"""Profiles that several test modules share, made once per session, and the order of the files."""

import contextlib
import fcntl
import gc
import os
import signal
import socket
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import settings
from loopback import Endpoint, free_port

from adapters.message import Message
from monitor.fitting.capability import Capability
from monitor.fitting.fitted import BatchSource
from monitor.profile import Profile, read_profile

DATA = Path(__file__).parent / "data"
WAITING = (
    "test_daemon.py",
    "test_chaos_crash.py",
    "test_live.py",
    "test_standby.py",
    "test_chaos_network.py",
    "test_zenoh_security.py",
    "test_soak.py",
    "test_record.py",
    "test_readme.py",
    "test_chaos_hostile.py",
    "test_shards.py",
    "test_chaos_zenoh.py",
    "test_fauio.py",
    "test_adapters_zenoh_link.py",
    "test_monitor_election.py",
    "test_monitor_operator_client.py",
)
"""Tests of daemons and networks, the longest first: they wait in real time and leave the processor to others."""
SYSTEM = ("test_console.py", "test_replay_report_page.py")
"""Hold system tests alone."""
FITS = "test_flights.py"
"""Begins with the fit that many other files need."""

# Collecting makes hardly any garbage, and much that is searched for it.
gc.disable()

# A shell starts what runs in the background deaf to Ctrl-C, and so would be every process that a test interrupts.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# A slow example on a loaded machine is no failure. Tests that do not say how many examples they need take fewer in each
# run of the suite; `make test-long` looks at all invariants again with many. Where CI runs, the examples are the same
# each time, as in hypothesis's own profile for it: a change is judged by what it changes.
_SAME = "CI" in os.environ
settings.register_profile("fauio", deadline=None, max_examples=8, derandomize=_SAME)
settings.register_profile("fauio-long", deadline=None, max_examples=300, derandomize=_SAME)
settings.load_profile("fauio")


def pytest_configure(config: pytest.Config) -> None:
    """Take many examples where the long tests are asked for."""
    if config.option.markexpr == "long":
        settings.load_profile("fauio-long")


def pytest_itemcollected(item: pytest.Item) -> None:
    """Count invariants as long tests too, where these are asked for."""
    if item.config.option.markexpr == "long" and getattr(getattr(item, "obj", None), "is_hypothesis_test", False):
        item.add_marker("long")


def pytest_collection_finish() -> None:
    """Let no search for garbage look through modules and collected tests, and let it search less often."""
    gc.freeze()
    gc.set_threshold(20_000, 20, 20)
    gc.enable()


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave out files of system tests where these are not asked for: their imports take a third of a second."""
    return True if collection_path.name in SYSTEM and "not system" in config.option.markexpr else None


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(
    collector: pytest.Collector,
) -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    """Begin in each process with another file: what one has compiled, the others find compiled."""
    report = yield
    if isinstance(collector, pytest.Directory) and "PYTEST_XDIST_WORKER" in os.environ:
        process, processes = int(os.environ["PYTEST_XDIST_WORKER"][2:]), int(os.environ["PYTEST_XDIST_WORKER_COUNT"])
        first = len(report.result) * process // processes
        report.result = report.result[first:] + report.result[:first]
    return report


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Spread the files that wait over the first half of those that compute: none waits alone at the end."""
    files = dict.fromkeys(item.path.name for item in items)
    waiting = [name for name in WAITING if name in files]
    others = sorted((name for name in files if name not in WAITING), key=lambda name: (name != FITS, name))
    place = {name: float(k) for k, name in enumerate(others)}
    place |= {name: 0.5 * len(others) * k / len(waiting) - 0.5 for k, name in enumerate(waiting)}
    items.sort(key=lambda item: (place[item.path.name], item.path.name))


@pytest.fixture
def endpoint() -> Iterator[Endpoint]:
    """Return a monitor's session, and what clients need to connect to it."""
    made = Endpoint()
    yield made
    made.close()


@pytest.fixture
def port() -> int:
    """Return a UDP port of loopback that nobody listens on."""
    return free_port(socket.SOCK_DGRAM)


@pytest.fixture(scope="session")
def data() -> Path:
    """Return the folder of the flight excerpts."""
    return DATA


def made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], object]) -> Path:
    """Return a folder that processes which share the suite share: whoever comes first makes it, the others wait."""
    base = factory.getbasetemp()
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    folder = shared / "shared" / name
    folder.parent.mkdir(exist_ok=True)
    with (shared / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not folder.exists():
            make(folder)
    return folder


@pytest.fixture(scope="session", autouse=True)
def inequalities_solved_once(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Solve each inequality of a design once in a run of the suite: many tests design observers of the same plants.

    Solutions are kept with the run's own temporary files, by all that goes into the inequality.
    """
    from kept_solutions import kept_solutions

    folder = made_once(tmp_path_factory, "solutions", Path.mkdir)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gains.synthesis.convex.solve_bounded_real", kept_solutions(folder))
        yield


@pytest.fixture(scope="session")
def arm_profile(tmp_path_factory: pytest.TempPathFactory) -> Profile:
    """Write the profile of the reference arm."""
    from replay.demonstration.arm_profile import write_arm_profile

    return read_profile(made_once(tmp_path_factory, "arm", write_arm_profile))


@contextlib.contextmanager
def plain_fits() -> Iterator[None]:
    """Fit without measuring what a profile will detect, and without its comparison on data kept back, a fit by itself.

    Few tests need them.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("replay.fit._measured", lambda fitted, *_: fitted)
        patch.setattr("replay.fit.draw_comparison", lambda *_: None)
        patch.setattr("monitor.vehicles.multirotor.fit.compare_kept_back", lambda *_: None)
        yield


@pytest.fixture(scope="session")
def quad_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Fit a profile on the two healthy excerpts with the command a user types."""
    import fauio
    from replay.sensitivity.capability import measure_capability

    def of_motor2(profile: Profile, logs: Sequence[BatchSource]) -> tuple[Capability, ...]:
        [observer] = profile.observers
        alarms = tuple(rule for rule in observer.alarms if rule.channel == "motor2")
        return measure_capability(replace(profile, observers=(replace(observer, alarms=alarms),)), logs)

    def fit(folder: Path) -> None:
        healthy = [str(DATA / f"copter_healthy_{name}.tlog.xz") for name in ("square", "vel_gusty")]
        with pytest.MonkeyPatch.context() as patch:
            # All channels take a third of the fit, and the picture, which that of the plane has too, a tenth.
            patch.setattr("replay.fit.measure_capability", of_motor2)
            patch.setattr("replay.fit.draw_comparison", lambda *_: None)
            assert fauio.main(["fit", "--vehicle", "multirotor", *healthy, "-o", str(folder)]) == 0

    return made_once(tmp_path_factory, "quad", fit)


@pytest.fixture(scope="session")
def quad_profile(quad_folder: Path) -> Profile:
    """Read the fitted profile back."""
    return read_profile(quad_folder)


@pytest.fixture(scope="session")
def bundled_quad() -> Profile:
    """Read the quadrotor's profile that fauio brings with it."""
    return read_profile(Path(__file__).parent.parent / "replay" / "data" / "quad")


@pytest.fixture(scope="session")
def calm_flight() -> list[Message]:
    """Return the first 24 s of a healthy flight."""
    from adapters.logs.recordings import read_recording

    messages = list(read_recording(DATA / "copter_healthy_square.tlog.xz"))
    return [message for message in messages if message.received_ns - messages[0].received_ns < 24_000_000_000]
