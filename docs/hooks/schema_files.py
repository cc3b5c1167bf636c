"""The JSON Schemas as files: ``python docs/hooks/schema_files.py`` writes them into ``docs/schemas``."""

from __future__ import annotations

from pathlib import Path

from monitor.bus.schemas import SCHEMAS, schema_text

FOLDER = Path(__file__).parents[1] / "schemas"

if __name__ == "__main__":
    for name in SCHEMAS:
        (FOLDER / f"{name}.json").write_text(schema_text(name), encoding="utf-8")
