"""The report of a design as lines for a person."""

from __future__ import annotations

from pathlib import Path
from typing import Any


def design_text(report: dict[str, Any], out: Path | None) -> str:
    """Return the report that ``fauio design`` prints, with the file the gains were written to, if any."""
    continuous = report["domain"] == "continuous"
    at = "" if report["rate_hz"] is None else f" at {report['rate_hz']:g} Hz"
    where = "infinite frequency" if report["norm_hz"] is None else f"{report['norm_hz']:.3g} Hz"
    lines = [
        f"{report['model']}: {'continuous ' if continuous else ''}{report['method']} design{at}",
        *([] if report["sqrt_mu"] is None else [f"  certified sqrt(mu)  {report['sqrt_mu']:.6g}"]),
        *([] if report["floor"] is None else [f"  no observer below   {report['floor']:.6g}"]),
        *([] if report["norm"] is None else [f"  H-infinity norm     {report['norm']:.6g} at {where}"]),
        *([] if report.get("h2") is None else [f"  H2 norm at most     {report['h2']:.6g}"]),
        f"  certificate         {_proof(report['certificate'])}",
        f"  slowest pole        {report['poles_max_re']:.4g} rad/s"
        if continuous
        else f"  largest pole        {report['poles_max_abs']:.6f}",
        f"  largest gain        {report['gain_max_abs']:.4g}",
        f"  time                {report['solve_s']:.2f} s in the solver, {report['total_s']:.2f} s in all",
        *(f"  note                {note}" for note in report["notes"]),
    ]
    if out is not None:
        lines.append(f"  written to          {out}")
    return "\n".join(lines) + "\n"


def _proof(certificate: dict[str, Any]) -> str:
    if not certificate["holds"]:
        return "none"
    over = {"vertices": ", at every slope vertex", "multipliers": ", for all slopes at once"}
    return f"holds with margin {certificate['margin']:.2g}{over.get(certificate.get('proof', ''), '')}"
