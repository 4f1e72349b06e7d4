"""Times MBPO of mbrl-lib 0.2.0 for `bench.py compare`; runs in a virtual environment of its own (peer.py).

    PEER/bin/python tools/benches/peer_mbrl_lib.py SETTINGS

SETTINGS is JSON: `updates`, `models`, `width`, `batch`, `starts`, `random_steps`, `learning_steps`. Prints a line of
JSON: the seconds of every learning step.
"""

import itertools
import json
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import torch._dynamo  # before mujoco is loaded, or the process crashes  # isort: skip
import gymnasium
import hydra
import torch
from mbrl.algorithms import mbpo
from mbrl.env import termination_fns


class Clock(gymnasium.Wrapper):
    """When every step began."""

    def __init__(self, env: gymnasium.Env):
        super().__init__(env)
        self.at: list[float] = []

    def step(self, action):
        self.at.append(time.perf_counter())
        return super().step(action)


def composed(words: list[str]) -> Any:
    """The settings that its own examples would have."""
    with tempfile.TemporaryDirectory() as folder:
        configs = Path(shutil.copytree(Path(mbpo.__file__).parents[1] / "examples" / "conf", f"{folder}/conf"))
        (configs / "action_optimizer").mkdir()
        (configs / "action_optimizer" / "cem.yaml").write_text("{}")  # of planning, which the wheel forgot
        with hydra.initialize_config_dir(str(configs), version_base="1.1"):
            return hydra.compose("main", overrides=words)


def main(same: dict[str, int]) -> None:
    steps = same["learning_steps"]
    words = [
        "algorithm=mbpo",
        "overrides=mbpo_hopper",
        "dynamics_model=gaussian_mlp_ensemble",
        "+dynamics_model._recursive_=false",  # as Hydra before 1.1, which its files are for
        "device=cpu",
        f"dynamics_model.ensemble_size={same['models']}",
        f"overrides.num_elites={same['models']}",
        f"overrides.num_sac_updates_per_step={same['updates']}",
        f"overrides.sac_hidden_size={same['width']}",
        f"overrides.sac_batch_size={same['batch']}",
        f"overrides.effective_model_rollouts_per_step={same['starts'] // 250}",
        "overrides.sac_automatic_entropy_tuning=true",
        "overrides.sac_target_entropy=-1",
        "overrides.sac_target_update_interval=1",
        "overrides.rollout_schedule=[20,100,1,15]",
        f"overrides.epoch_length={steps}",  # evaluated once, after the last step
        f"overrides.num_steps={steps}",
        # Its file asks for a class of the old gym. All that is read are low, high and shape.
        "algorithm.agent.action_space._target_=types.SimpleNamespace",
        "+algorithm.agent.action_space._convert_=all",
        "algorithm.real_data_ratio=0.05",
        "algorithm.random_initial_explore=true",
        f"algorithm.initial_exploration_steps={same['random_steps']}",
    ]
    settings = composed(words)
    env = Clock(gymnasium.make("Hopper-v4"))
    with tempfile.TemporaryDirectory() as folder:
        mbpo.train(env, gymnasium.make("Hopper-v4"), termination_fns.hopper, settings, silent=True, work_dir=folder)
    learning = env.at[same["random_steps"] :]
    seconds = [after - before for before, after in itertools.pairwise(learning)]
    print(json.dumps({"seconds": seconds, "threads": torch.get_num_threads(), "torch": torch.__version__}))


if __name__ == "__main__":
    main(json.loads(sys.argv[1]))
