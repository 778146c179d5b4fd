"""What the pages of the panel request by HTTP, each with the token and a JSON object."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from haselab.base import JsonObject
from haselab.panel.files import PanelFiles
from haselab.panel.pages.chip_budget import chip_budget
from haselab.panel.pages.design import DESIGN_REQUESTS
from haselab.panel.pages.doctor import examine
from haselab.panel.pages.pick import PICK_REQUESTS, Videos
from haselab.panel.pages.recordings import analyse, compare, listed, note, report
from haselab.panel.pages.study_job import available, check

__all__ = ["REQUESTS"]

_Request = Callable[[PanelFiles, JsonObject], JsonObject]


def _on_videos(carry_out: Callable[[Videos, JsonObject], JsonObject]) -> _Request:
    """A request of the page Pick, on the videos of the recordings."""
    return lambda files, values: carry_out(Videos(files.runs), values)


REQUESTS: Mapping[str, _Request] = {
    "studies": lambda files, values: available(files),
    "check-study": check,
    "recordings": listed,
    "note": note,
    "report": report,
    "analyse": analyse,
    "compare": compare,
    "doctor": lambda files, values: examine(files.rig),
    **{name: _on_videos(carry_out) for name, carry_out in PICK_REQUESTS.items()},
    **DESIGN_REQUESTS,
    "design-budget": chip_budget,
}
"""By name: called in a thread of the web server. A `HaselabError` becomes the page's message."""
