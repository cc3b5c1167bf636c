"""The report of a design as lines for a person."""

from __future__ import annotations

from pathlib import Path
from typing import Any


def text(found: dict[str, Any], out: Path | None) -> str:
    """Return the report that ``fauio design`` prints, with the file the gains were written to, if any."""
    continuous = found["domain"] == "continuous"
    at = "" if found["rate_hz"] is None else f" at {found['rate_hz']:g} Hz"
    where = "infinite frequency" if found["norm_hz"] is None else f"{found['norm_hz']:.3g} Hz"
    lines = [
        f"{found['model']}: {'continuous ' if continuous else ''}{found['method']} design{at}",
        *([] if found["sqrt_mu"] is None else [f"  certified sqrt(mu)  {found['sqrt_mu']:.6g}"]),
        *([] if found["floor"] is None else [f"  no observer below   {found['floor']:.6g}"]),
        *([] if found["norm"] is None else [f"  H-infinity norm     {found['norm']:.6g} at {where}"]),
        *([] if found.get("h2") is None else [f"  H2 norm at most     {found['h2']:.6g}"]),
        f"  certificate         {_proof(found['certificate'])}",
        f"  slowest pole        {found['poles_max_re']:.4g} rad/s"
        if continuous
        else f"  largest pole        {found['poles_max_abs']:.6f}",
        f"  largest gain        {found['gain_max_abs']:.4g}",
        f"  time                {found['solve_s']:.2f} s in the solver, {found['total_s']:.2f} s in all",
        *(f"  note                {note}" for note in found["notes"]),
    ]
    if out is not None:
        lines.append(f"  written to          {out}")
    return "\n".join(lines) + "\n"


def _proof(certificate: dict[str, Any]) -> str:
    if not certificate["holds"]:
        return "none"
    over = {"vertices": ", at every slope vertex", "multipliers": ", for all slopes at once"}
    return f"holds with margin {certificate['margin']:.2g}{over.get(certificate.get('proof', ''), '')}"
