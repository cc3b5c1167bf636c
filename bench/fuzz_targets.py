"""All fuzz targets by name, the most exposed first."""

from __future__ import annotations

import fuzz_adapters
import fuzz_cuts
import fuzz_files
import fuzz_logs
import fuzz_monitor
import fuzz_onboard
import fuzz_pipeline
import fuzz_recordings

_MODULES = (
    fuzz_adapters,
    fuzz_recordings,
    fuzz_logs,
    fuzz_onboard,
    fuzz_pipeline,
    fuzz_monitor,
    fuzz_files,
    fuzz_cuts,
)
_ORDER = ("mavlink", "zenoh", "commands", "subscriber", "pipeline-quad", "cdr", "mcap", "tlog", "foreign", "cuts")
_ALL = {target.name: target for module in _MODULES for target in module.TARGETS}

TARGETS = {name: _ALL[name] for name in (*_ORDER, *(name for name in _ALL if name not in _ORDER))}
