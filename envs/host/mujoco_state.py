"""Saving and restoring C MuJoCo exactly."""

import copy
from typing import Any

import mujoco
import numpy as np

_STATE = mujoco.mjtState.mjSTATE_INTEGRATION
# What C MuJoCo notes where it has diverged; it goes on from the model's initial state as if nothing had happened.
_DIVERGED = (
    mujoco.mjtWarning.mjWARN_BADQPOS,
    mujoco.mjtWarning.mjWARN_BADQVEL,
    mujoco.mjtWarning.mjWARN_BADQACC,
)


class MujocoState:
    """Remembers where the last control step of one simulator began.

    The positions and velocities alone do not restore a simulator bit for bit: body frames lag one substep behind
    them, and tasks read those. Replaying the last control step from the state before it does. Some tasks also move
    targets by changing the model at the start of an episode: what differs from the model as it was built is saved.
    """

    def __init__(self, model: Any, data: Any):
        self._model, self._data = model, data
        self._built = copy.deepcopy(model)
        self._fields = [name for name in dir(model) if isinstance(_array(model, name), np.ndarray)]
        self._before: np.ndarray = self._read()
        self._action: np.ndarray | None = None

    def _read(self) -> np.ndarray:
        state = np.empty(mujoco.mj_stateSize(self._model, _STATE))
        mujoco.mj_getState(self._model, self._data, state, _STATE)
        return state

    def begin_episode(self) -> None:
        """To be called after a reset."""
        self._before, self._action = self._read(), None

    def begin_step(self, action: np.ndarray) -> None:
        """To be called before a control step."""
        self._before, self._action = self._read(), np.array(action)
        for warning in _DIVERGED:
            self._data.warning[warning].number = 0

    @property
    def diverged(self) -> bool:
        """Whether the simulator has, in the control step that was begun last: what it gives is no successor then."""
        return any(self._data.warning[warning].number > 0 for warning in _DIVERGED)

    def save(self) -> dict[str, Any]:
        return {
            "before": self._before.tolist(),
            "action": None if self._action is None else self._action.tolist(),
            "model": {
                name: getattr(self._model, name).tolist()
                for name in self._fields
                if not np.array_equal(getattr(self._model, name), getattr(self._built, name))
            },
        }

    def load(self, saved: dict[str, Any]) -> np.ndarray | None:
        """Puts the simulator where the last control step began; the action of that step is yet to be replayed."""
        for name, value in saved["model"].items():
            getattr(self._model, name)[...] = value
        self._before = np.array(saved["before"])
        self._action = None if saved["action"] is None else np.array(saved["action"])
        mujoco.mj_setState(self._model, self._data, self._before, _STATE)
        mujoco.mj_forward(self._model, self._data)
        mujoco.mj_setState(self._model, self._data, self._before, _STATE)  # forward moved the solver's warm start
        return self._action


def _array(model: Any, name: str) -> Any:
    """A field of the model; None where it is none, or text."""
    value = None if name.startswith("_") else getattr(model, name, None)
    return value if isinstance(value, np.ndarray) and value.dtype.kind in "biuf" else None
