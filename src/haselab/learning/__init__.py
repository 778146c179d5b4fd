"""Environments for reinforcement learning: a closed loop on many twins (Gymnasium).

Importing this package registers `haselab/Track-v0`, `haselab/Hold-v0` and `haselab/Gait-v0`.
"""

try:
    import gymnasium
except ModuleNotFoundError:
    raise ModuleNotFoundError(
        "haselab.learning needs gymnasium, which is not installed. "
        "Run: pip install 'haselab[learning]'",
        name="gymnasium",
    ) from None

from haselab.learning.environment import StrainEnv
from haselab.learning.tasks import TASKS, LearningTask
from haselab.learning.training import Progress, train
from haselab.learning.vector_environment import StrainVectorEnv

__all__ = ["TASKS", "LearningTask", "Progress", "StrainEnv", "StrainVectorEnv", "train"]

for _task in TASKS:
    gymnasium.register(
        id=f"haselab/{_task.capitalize()}-v0",
        entry_point="haselab.learning.environment:StrainEnv",
        vector_entry_point="haselab.learning.vector_environment:StrainVectorEnv",
        kwargs={"task": _task},
    )
