"""The numbers of metrics.jsonl: what each is called, and how it is drawn. One that is not named here is logged and
drawn all the same, under the name that it has in the log."""

from typing import NamedTuple


class Quantity(NamedTuple):
    """One of them.

    Attributes:
        label: of an axis.
        caption: below its picture in a report, among those of the inside of a run; without one it is not drawn there.
        scale: linear; log where it spans powers of ten; or unit, from 0 to 1.
        always: whether it is in every line: null where nothing learns so.
    """

    label: str
    caption: str = ""
    scale: str = "linear"
    always: bool = False


QUANTITIES = {
    "env_steps": Quantity("environment steps"),
    "seconds": Quantity("seconds"),
    "eval_return": Quantity("evaluation return"),
    "train_return": Quantity("return in training"),
    "eval_length": Quantity("length of evaluation episodes"),
    "eval_broken_off": Quantity("evaluation episodes that were broken off"),
    "real_ratio": Quantity(
        "λ, the share of real data", "λ: the share of real rows in what policies learn from", "unit", always=True
    ),
    "real_ratio_probs": Quantity("probability of each λ"),
    "temperature": Quantity("temperature τ", always=True),
    "critic_loss": Quantity("critic loss", "critic loss", "log", always=True),
    "actor_loss": Quantity("actor loss", "actor loss", always=True),
    "alpha": Quantity("SAC's entropy coefficient α", "α: SAC's entropy coefficient", always=True),
    "entropy": Quantity("policy entropy", "entropy of the policies", always=True),
    "q_mean": Quantity("mean Q", "mean Q of what is learned from", always=True),
    "model_loss": Quantity(
        "model loss (negative log-likelihood)",
        "negative log-likelihood of the models (equation 17; weighted, where nll_beta is)",
    ),
    "model_val_mse": Quantity("model validation error", "validation error of the models", "log", always=True),
    "env_steps_per_s": Quantity(
        "environment steps per second", "environment steps per second, all seeds together", "log"
    ),
    "updates_per_s": Quantity("updates per second", "SAC updates per second, all members together"),
    "imagined_per_s": Quantity("imagined steps per second"),
}


def of(name: str) -> Quantity:
    """What is known of the number that the log calls `name`."""
    return QUANTITIES.get(name, Quantity(name))
