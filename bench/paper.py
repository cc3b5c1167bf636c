"""The paper's three disturbed cases: errors of our estimates beside the printed ones.

    python bench/paper.py

Prints a Markdown table: root mean square errors over 50 s at 100 Hz, f_a compared one sample later, because an
estimate cannot know a jump before the first sample after it.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from adapters.arm import SCENARIOS, simulate_arm
from monitor.observer import Observer
from replay.arm_profile import write_arm_profile

PRINTED = {"case1": (0.0076, 0.0078), "case2": (0.0340, 0.0295), "case3": (0.0189, 0.0120)}


def rmse(error: NDArray[np.float64]) -> float:
    """Return the root mean square of an error."""
    return float(np.sqrt(np.mean(error**2)))


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        gains = write_arm_profile(Path(folder)).observers[0].gains
    print("| case | f_a, paper | f_a, ours | f_s, paper | f_s, ours (floor 0.00707) |")
    print("|---|---|---|---|---|")
    for case, (printed_fa, printed_fs) in PRINTED.items():
        run = simulate_arm(SCENARIOS[case], 50.0, 100.0)
        fault = Observer(gains).run(run.u, run.y).fault
        f_a, f_s = rmse(fault[1:, 0] - run.f_a[:-1, 0]), rmse(fault[:, 1] - run.f_s[:, 0])
        print(f"| {case} | {printed_fa:.4f} | {f_a:.4f} | {printed_fs:.4f} | {f_s:.4f} |")


if __name__ == "__main__":
    main()
