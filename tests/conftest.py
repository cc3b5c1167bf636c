"""Profiles that several test modules share, made once per session."""

import fcntl
import os
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import settings

from monitor.profile import Profile, read_profile
from replay.demonstration.arm_profile import write_arm_profile

DATA = Path(__file__).parent / "data"

# A slow example on a loaded machine is no failure.
settings.register_profile("fauio", deadline=None)
settings.load_profile("fauio")


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


@pytest.fixture(scope="session")
def arm_profile(tmp_path_factory: pytest.TempPathFactory) -> Profile:
    """Write the profile of the reference arm."""
    return read_profile(made_once(tmp_path_factory, "arm", write_arm_profile))


@pytest.fixture(scope="session")
def quad_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Fit a profile on the two healthy excerpts with the command a user types."""
    import fauio

    def fit(folder: Path) -> None:
        healthy = [str(DATA / f"copter_healthy_{name}.tlog.xz") for name in ("square", "vel_gusty")]
        assert fauio.main(["fit", "--vehicle", "multirotor", *healthy, "-o", str(folder)]) == 0

    return made_once(tmp_path_factory, "quad", fit)


@pytest.fixture(scope="session")
def quad_profile(quad_folder: Path) -> Profile:
    """Read the fitted profile back."""
    return read_profile(quad_folder)
