"""What the pages of the panel request by HTTP, each with the token and a JSON object."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from haselab.base import JsonObject
from haselab.panel.doctor import examine
from haselab.panel.files import PanelFiles
from haselab.panel.recordings import analyse, compare, listed, note, report
from haselab.panel.study_job import available, check

__all__ = ["REQUESTS"]

REQUESTS: Mapping[str, Callable[[PanelFiles, JsonObject], JsonObject]] = {
    "studies": lambda files, values: available(files),
    "check-study": check,
    "recordings": listed,
    "note": note,
    "report": report,
    "analyse": analyse,
    "compare": compare,
    "doctor": lambda files, values: examine(files.rig),
}
"""By name: called in a thread of the web server. A `HaselabError` becomes the page's message."""
