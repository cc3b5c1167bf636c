"""The report of a fit."""

from pathlib import Path

import numpy as np

from gains.identification.excitation import ExcitationVerdict
from gains.identification.residuals import residual_statistics
from monitor.fitting.fit_report import Comparison, comparison_lines, draw_comparison, parameter_lines


def comparison() -> Comparison:
    rng = np.random.default_rng(0)
    t = np.arange(500) / 50.0
    residual = 0.1 * rng.normal(size=(500, 2))
    predicted = np.column_stack([np.sin(t), np.cos(t)])
    predicted[250] = np.nan
    return Comparison(
        names=("roll_rate", "pitch_rate"),
        times=t,
        measured=predicted + residual,
        predicted=predicted,
        residuals=residual,
        explained={"simulation explains": np.array([0.98, 0.5])},
        statistics=residual_statistics(("roll_rate", "pitch_rate"), [residual]),
    )


def test_every_output_gets_a_line() -> None:
    lines = comparison_lines(comparison())
    assert lines[0].startswith("roll_rate   simulation explains 98.0 %; residual 0.0984 rms")
    assert "white" in lines[1]


def test_what_is_not_determined_stands_out() -> None:
    lines = parameter_lines(
        [
            ExcitationVerdict("mass", 2.0, 0.01, True, ""),
            ExcitationVerdict("drag", 0.1, 3.0, False, "record manoeuvres that move speed"),
        ]
    )
    assert lines == ["mass  2 +- 0.01", "drag  0.1 +- 3  NOT DETERMINED: record manoeuvres that move speed"]


def test_the_picture_has_a_row_for_each_output(tmp_path: Path) -> None:
    draw_comparison(tmp_path / "fit.png", comparison(), "a quad")
    header = (tmp_path / "fit.png").read_bytes()[:24]
    assert header.startswith(b"\x89PNG")
    assert int.from_bytes(header[20:24], "big") > 400
