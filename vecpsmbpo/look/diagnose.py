"""`vecpsmbpo diagnose`: how far a run's models and critics can be trusted, measured on fresh episodes.

The file that it writes has, of the newest checkpoint:

    models   errors of every model up to `horizon` steps ahead, and how well it knew them; null where none is fitted
    critics  Q of the members beside what was really earned from the same states; null where there are none
    states   where imagined states lie among real ones; null where nothing is imagined
    history  a few numbers of every checkpoint that is kept: `keep_checkpoints` says how many those are
"""

import contextlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vecpsmbpo import arguments
from vecpsmbpo.look import files, runs
from vecpsmbpo.look.runs import Run
from vecpsmbpo.look.working import Working
from vecpsmbpo.settings import SettingError
from vecpsmbpo.words import of as in_words

if TYPE_CHECKING:
    from vecpsmbpo.look.members import Trained

Array = np.ndarray

FILE = "diagnostics.json"  # in a run's directory, where `report` finds it
PARTS = ("task", "lane", "episodes", "env_steps", "models", "critics", "states", "history")  # of it, that are drawn
# What reading and drawing a file raises that is none, or whose parts are of other kinds than `measure` gives them.
DAMAGE = (OSError, LookupError, TypeError, AttributeError, ValueError, RecursionError)
OPTIONS = {
    "episodes": arguments.whole("fresh ones, of every member", 1, at_least=1),
    "horizon": arguments.whole("steps ahead that models are asked for", 50, at_least=1),
    "lane": arguments.whole("of which seed and swept value, counted from 0", 0),
    "seed": arguments.whole("of the fresh episodes", 0, at_most=2**31 - 1),
    "out": arguments.out(
        "the numbers, or a picture of them; without it, into the run", "", ".json", ".png", ".svg", ".pdf"
    ),
}
SHOWN = 1000  # states of a picture


def run(words: Sequence[str]) -> int:
    """The command; its exit status.

    Raises:
        SettingError: a mistake in `words`, the run has no checkpoint, or the file cannot be written.
    """
    named, options = arguments.parse("diagnose", words, OPTIONS)
    (path,) = arguments.run_dirs("diagnose", named, most=1)
    out = options.pop("out") or path / FILE
    files.check_writable(out)
    found = runs.load(path)
    runs.check_lane(found, options["lane"])
    with Working() as working:
        write(measure(found, **options, working=working), out)
    print(f"written: {out}")
    return 0


def write(diagnosis: dict[str, Any], out: Path) -> None:
    """As numbers or as a picture, as the name of the file says.

    Raises:
        SettingError: it cannot be written.
    """
    if out.suffix.lower() == ".json":
        files.write_text(out, json.dumps(diagnosis, allow_nan=False) + "\n")
    else:
        from vecpsmbpo.look import diagrams

        diagrams.write(diagnosis, out)


def read(run: Run) -> dict[str, Any] | None:
    """What lies in the run's directory; None where nothing does.

    Raises:
        SettingError: it cannot be read.
    """
    path = run.path / FILE
    if not path.exists():
        return None
    with reading(run):
        found = json.loads(path.read_text())
        return {**{name: found[name] for name in PARTS}, **found}


@contextlib.contextmanager
def reading(run: Run) -> Iterator[None]:
    """In it the run's file is read, or drawn, which nobody has checked: whatever is wrong with it is one line.

    Raises:
        SettingError: something is.
    """
    try:
        yield
    except DAMAGE as error:
        raise SettingError(
            f"{run.path / FILE}: cannot be read ({in_words(error)}); vecpsmbpo diagnose {run.path} writes it again"
        ) from None


def measure(
    run: Run, *, episodes: int = 1, horizon: int = 50, lane: int = 0, seed: int = 0, working: Working | None = None
) -> dict[str, Any]:
    """The diagnosis of a lane, in JSON's types.

    Args:
        episodes: of each member.
        horizon: steps that are looked ahead.
        seed: of the fresh episodes.
        working: is told what is being measured.

    Raises:
        SettingError: there is no checkpoint, or no such lane.
    """
    from vecpsmbpo.look import diagnostics, members  # and JAX with them

    working = working or Working()  # which nobody has entered: it says nothing
    working.on("reading checkpoints")
    history, found, probe = [], {}, None
    for trained in members.load_each(run, lane):
        probe = probe or _Probe(trained, episodes, horizon, seed)
        found = probe.examine(trained, working)
        history.append({"env_steps": trained.step, **_summary(found)})
        del trained  # as in `evaluate.restore_each`
    about = {"task": run.settings.task, "run": run.name, "lane": run.settings.lanes[lane], "episodes": episodes}
    return diagnostics.finite({**about, **found, "history": history})


def _summary(found: dict[str, Any]) -> dict[str, Any]:
    """What is followed over training."""
    critics, models = found["critics"], found["models"]
    return {
        "critics": critics and {name: critics[name] for name in ("q", "earned", "bias", "spread_of_bias")},
        "errors": models and [float(np.mean(models["relative"]["error"], axis=0)[at]) for at in (0, -1)],
    }


class _Probe:
    """Measures of one lane's checkpoints after another, in the same worlds and compiled programs."""

    def __init__(self, trained: "Trained", episodes: int, horizon: int, seed: int):
        from vecpsmbpo.look import diagnostics, fresh

        settings, self._horizon, self._seed = trained.run.settings, horizon, seed
        self._each = episodes
        spec = trained.algorithm.spec
        self._length = settings.episode_length or spec.episode_length
        self._steps = self._length
        if trained.has_members:  # who have critics; a time limit is no part of the task, nor of what these are asked
            self._discount = float(trained.of_lane(trained.state.hyper.discount))
            self._steps += diagnostics.tail(self._discount)
        members = settings.n_members if trained.has_members else 1
        self._world = fresh.world(settings, members * episodes, self._steps, seed)

    def examine(self, trained: "Trained", working: Working) -> dict[str, Any]:
        """One checkpoint."""
        import jax

        from vecpsmbpo.look import fresh

        key = jax.random.key(self._seed)
        self._world.rewind()
        act = _members_act(trained, self._each) if trained.has_members else _evaluation_act(trained, self._each)
        at = f"step {trained.step:,}"
        each = partial(working.through, what=f"{at}: fresh episodes")
        seen = fresh.collect(self._world, act, self._steps, key, each=each)
        random = np.random.default_rng(self._seed)
        found: dict[str, Any] = {"env_steps": trained.step}
        working.on(f"{at}: models")
        found["models"] = self._models(trained, seen, random, jax.random.fold_in(key, self._steps))
        working.on(f"{at}: critics")
        found["critics"] = self._critics(trained, seen, random)
        working.on(f"{at}: imagined states")
        found["states"] = _states(trained, seen, random)
        return found

    def _models(self, trained: "Trained", seen: Any, random: np.random.Generator, key: Any) -> dict[str, Any] | None:
        from vecpsmbpo.look import diagnostics

        models, spec = trained.models(), trained.algorithm.spec
        if models is None:
            return None
        net = trained.algorithm.model_net
        windows = diagnostics.windows(seen, self._horizon, self._length, random)
        windows = windows.until(int(windows.there.any(axis=0).sum()))
        mean, variance = diagnostics.imagine(models, windows.obs, windows.action, key, net=net, spec=spec)
        errors = diagnostics.errors(np.asarray(mean), np.asarray(variance), windows)
        steps = np.argwhere(seen.there[:, : self._length])
        rows = tuple(steps[random.permutation(len(steps))[: diagnostics.ROWS]].T)
        truth = np.concatenate([seen.next_obs[rows], seen.reward[rows][:, None]], axis=-1)
        ahead = diagnostics.one_step(models, seen.obs[rows], seen.action[rows], truth, net=net)
        ahead = diagnostics.OneStep(*map(np.asarray, ahead))
        std = truth.std(axis=0)
        return {
            "dimensions": [*(f"obs {index}" for index in range(spec.obs_size)), "reward"],
            "spread": std,
            "windows": windows.there.sum(axis=0),
            **errors._asdict(),
            "relative": {name: diagnostics.relative(values, std) for name, values in errors._asdict().items()},
            "levels": diagnostics.LEVELS,
            **diagnostics.calibration(ahead)._asdict(),
            "reliability": diagnostics.reliability(ahead, std)._asdict(),
        }

    def _critics(self, trained: "Trained", seen: Any, random: np.random.Generator) -> dict[str, Any] | None:
        from vecpsmbpo.look import diagnostics, members

        if not trained.has_members:
            return None
        critics, alpha = trained.critics()
        nets = trained.nets
        shape = (len(alpha), -1)
        obs, action = (x.reshape(*shape, x.shape[-1]) for x in (seen.obs, seen.action))
        q = np.asarray(diagnostics.values(critics, obs, action, nets=nets)).reshape(seen.reward.shape)
        earned = diagnostics.returns(seen, self._discount, np.repeat(alpha, self._each))
        plain = diagnostics.returns(seen, self._discount, np.zeros(len(q)))
        known = diagnostics.known(seen, self._discount)
        known[:, self._length :] = False
        if not known.any():
            return None
        places = np.argwhere(known)
        places = places[random.permutation(len(places))[:SHOWN]]
        member = np.repeat(np.arange(len(alpha)), self._each)
        chosen = tuple(places.T)
        bias = (q - earned)[known]
        return {
            "members": members.member_names(trained.run),
            "states": int(known.sum()),
            "discount": self._discount,
            "q": q[known].mean(),
            "earned": earned[known].mean(),
            "earned_without_entropy": plain[known].mean(),
            "bias": bias.mean(),
            "spread_of_bias": bias.std(),
            "shown": {"member": member[places[:, 0]], "q": q[chosen], "earned": earned[chosen]},
        }


def _members_act(trained: "Trained", each: int) -> Any:
    """Every member in `each` episodes of its own, acting as in training."""
    from vecpsmbpo.look import diagnostics

    actor, actors = trained.nets.actor, trained.actors()
    count = trained.run.settings.n_members

    def act(step: int, obs: Array, key: Any) -> tuple[Any, Any]:
        action, log_prob = diagnostics.sample(actors, obs.reshape(count, each, -1), key, actor=actor)
        return action.reshape(count * each, -1), log_prob.reshape(-1)

    return act


def _evaluation_act(trained: "Trained", each: int) -> Any:
    """What has no members: as it is evaluated."""
    import jax
    import jax.numpy as jnp

    from vecpsmbpo.drivers.common import broadcast_leaves, evaluation_actions, evaluation_policies
    from vecpsmbpo.layout import BY_SEED, SHARED, Layout

    algorithm = trained.algorithm
    policies = evaluation_policies(algorithm)(trained.state, trained.state.key)
    policy = jax.tree.map(lambda x: np.asarray(x[trained.index : trained.index + 1]), policies)
    alone = replace(algorithm, layout=Layout.of(replace(trained.run.settings, num_seeds=1, sweep=())))
    act = alone.layout.jit_shard_map(
        jax.vmap(partial(evaluation_actions, alone), in_axes=(0, None, 0, 0, 0)),
        (BY_SEED, SHARED, BY_SEED, BY_SEED, BY_SEED),
        (BY_SEED, BY_SEED),
    )
    memory = broadcast_leaves(alone.memory(), 1, each)

    def taken(step: int, obs: Array, key: Any) -> tuple[Array, Array]:
        nonlocal memory
        action, memory = act(policy, jnp.int32(step), memory, obs[None], jax.random.split(key, (1, each)))
        return np.asarray(action)[0], np.zeros(len(obs))

    return taken


def _states(trained: "Trained", seen: Any, random: np.random.Generator) -> dict[str, Any] | None:
    """Imagined states that policies learn from now, among real ones: in a plane, and how near they are."""
    from vecpsmbpo.look import diagnostics, states

    imagined = trained.imagined_states(SHOWN, random)
    if imagined is None:
        return None
    known = trained.real_states(5 * SHOWN, random)
    fresh = seen.next_obs[seen.there]
    fresh = fresh[random.permutation(len(fresh))[:SHOWN]]
    place, method = (states.plane, "UMAP") if states.has_umap() else (states.principal_plane, "principal components")
    real, unreal = place([known[:SHOWN], imagined])
    return {
        "method": method,
        "real": real,
        "imagined": unreal,
        "distance": diagnostics.nearness(known, imagined, fresh)._asdict(),
    }
