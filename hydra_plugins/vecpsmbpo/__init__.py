"""The launchers that `hydra/launcher=` may name besides Hydra's own. Hydra takes a launcher from this place alone; what
they do is in `vecpsmbpo.sweeps`."""

from collections.abc import Sequence
from functools import partial
from typing import Any

from hydra.core.utils import JobReturn, JobStatus
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf, open_dict


class Jobs(Launcher):
    """Hands a grid to `vecpsmbpo.sweeps`."""

    def __init__(self, launcher: str, **options: Any):
        self._name = launcher
        self._options = {
            key: OmegaConf.to_container(value, resolve=True) if OmegaConf.is_config(value) else value
            for key, value in options.items()
        }

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        self._context, self._config = hydra_context, config
        self._task: Any = task_function  # of `cli`, which keeps the exit status

    def launch(self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> Sequence[JobReturn]:
        from vecpsmbpo.sweeps import launch

        self._task.begun = True
        grid = [partial(self._settings, list(overrides)) for overrides in job_overrides]
        status = launch.launch(self._name, self._options, grid)
        self._task.worst = max(self._task.worst, status)
        return [JobReturn(status=JobStatus.COMPLETED) for _ in job_overrides]

    def _settings(self, overrides: list[str]) -> Any:
        """Of one run, as the task would have them."""
        from vecpsmbpo import config

        tree = self._context.config_loader.load_sweep_config(self._config, overrides)
        given = list(tree.hydra.overrides.task)
        with open_dict(tree):
            del tree["hydra"]
        return config.resolve(given, tree)
