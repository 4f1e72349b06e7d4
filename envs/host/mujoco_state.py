"""Saving and restoring C MuJoCo exactly."""

from typing import Any

import mujoco
import numpy as np

_STATE = mujoco.mjtState.mjSTATE_INTEGRATION


class MujocoState:
    """Remembers where the last control step of one simulator began.

    The positions and velocities alone do not restore a simulator bit for bit: body frames lag one substep behind
    them, and tasks read those. Replaying the last control step from the state before it does.
    """

    def __init__(self, model: Any, data: Any):
        self._model, self._data = model, data
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

    def save(self) -> dict[str, Any]:
        return {
            "before": self._before.tolist(),
            "action": None if self._action is None else self._action.tolist(),
        }

    def load(self, saved: dict[str, Any]) -> np.ndarray | None:
        """Puts the simulator where the last control step began; the action of that step is yet to be replayed."""
        self._before = np.array(saved["before"])
        self._action = None if saved["action"] is None else np.array(saved["action"])
        mujoco.mj_setState(self._model, self._data, self._before, _STATE)
        mujoco.mj_forward(self._model, self._data)
        mujoco.mj_setState(self._model, self._data, self._before, _STATE)  # forward moved the solver's warm start
        return self._action
