"""Which pages are generated from the code, and by which function."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from command_page import commands_page, exit_status_page
from file_pages import gains_page, model_page, profile_page
from findings_page import findings_page
from topic_pages import topics_page

PAGES: Mapping[str, Callable[[], str]] = {
    "reference/commands.md": commands_page,
    "reference/exit-status.md": exit_status_page,
    "reference/profile.md": profile_page,
    "reference/model.md": model_page,
    "reference/gains.md": gains_page,
    "reference/findings.md": findings_page,
    "reference/topics.md": topics_page,
}
