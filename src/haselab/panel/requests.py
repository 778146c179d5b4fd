"""What the pages of the panel request by HTTP, each with the token and a JSON object."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from haselab.base import JsonObject
from haselab.panel.chip_budget import chip_budget
from haselab.panel.design import DESIGN_REQUESTS
from haselab.panel.doctor import examine
from haselab.panel.files import PanelFiles

__all__ = ["REQUESTS"]

REQUESTS: Mapping[str, Callable[[PanelFiles, JsonObject], JsonObject]] = {
    "doctor": lambda files, values: examine(files.rig),
    **DESIGN_REQUESTS,
    "design-budget": chip_budget,
}
"""By name: called in a thread of the web server. A `HaselabError` becomes the page's message."""
