"""A stranger's desk: a folder with the files that the documentation's commands name, from the repository's own data."""

from __future__ import annotations

import lzma
import shutil
from pathlib import Path

ROOT = Path(__file__).parent.parent
DATA = ROOT / "tests" / "data"
FLIGHT = ROOT / "replay" / "data" / "copter_motor1.tlog.xz"
QUAD = ROOT / "replay" / "data" / "quad"
HEALTHY = ("copter_healthy_square", "copter_healthy_vel_gusty")


def unpack(packed: Path, to: Path, size: int | None = None) -> None:
    """Write what is packed, or its first bytes."""
    to.write_bytes(lzma.decompress(packed.read_bytes())[:size])


def lay_out(desk: Path) -> None:
    """Write healthy flights, one with a faulty motor, a folder of flights, a fitted profile, a model and gains."""
    for name, healthy in zip(("monday", "tuesday"), HEALTHY, strict=True):
        unpack(DATA / f"{healthy}.tlog.xz", desk / f"{name}.tlog")
    shutil.copy(desk / "monday.tlog", desk / "healthy.tlog")
    unpack(FLIGHT, desk / "flight.tlog")
    (desk / "flights").mkdir()
    for name in ("copter_5s", "copter_wind_step"):
        shutil.copy(DATA / f"{name}.tlog.xz", desk / "flights")
    shutil.copytree(QUAD, desk / "quad")
    shutil.copy(ROOT / "gains" / "models" / "arm.toml", desk / "arm.toml")
    shutil.copy(QUAD / "motors.motor1.gains.json", desk / "gains.json")


def lay_out_mistakes(desk: Path) -> None:
    """Write what goes wrong: files that are empty, text, too short, of another vehicle; folders with nothing in."""
    unpack(DATA / "copter_5s.tlog.xz", desk / "short.tlog")
    unpack(DATA / "rover_healthy.tlog.xz", desk / "rover.tlog")
    (desk / "empty.tlog").touch()
    (desk / "letter.tlog").write_text("Dear Sir or Madam\n")
    (desk / "flight.txt").write_text("Dear Sir or Madam\n")
    (desk / "empty").mkdir()
