"""The numbers of metrics.jsonl: what each is called, and how it is drawn. One that is not named here is logged and
drawn all the same, under the name that it has in the log."""

from typing import NamedTuple


class Number(NamedTuple):
    """One of them.

    Attributes:
        label: of an axis.
        caption: below its picture in a report, among those of the inside of a run; without one it is not drawn there.
        scale: linear; log where it spans powers of ten; or share, from 0 to 1.
        always: whether it is in every line: null where nothing learns so.
    """

    label: str
    caption: str = ""
    scale: str = "linear"
    always: bool = False


NUMBERS = {
    "env_steps": Number("environment steps"),
    "seconds": Number("seconds"),
    "eval_return": Number("evaluation return"),
    "train_return": Number("return in training"),
    "eval_length": Number("length of evaluation episodes"),
    "real_ratio": Number(
        "λ, the share of real data", "λ: the share of real rows in what policies learn from", "share", always=True
    ),
    "real_ratio_probs": Number("probability of each λ"),
    "temperature": Number("temperature τ", always=True),
    "critic_loss": Number("critic loss", "critic loss", "log", always=True),
    "actor_loss": Number("actor loss", "actor loss", always=True),
    "alpha": Number("SAC's entropy coefficient α", "α: SAC's entropy coefficient", always=True),
    "entropy": Number("policy entropy", "entropy of the policies", always=True),
    "q_mean": Number("mean Q", "mean Q of what is learned from", always=True),
    "model_loss": Number("model loss (negative log-likelihood)", "negative log-likelihood of the models (equation 17)"),
    "model_val_mse": Number("model validation error", "validation error of the models", "log"),
    "env_steps_per_s": Number(
        "environment steps per second", "environment steps per second, all seeds together", "log"
    ),
    "updates_per_s": Number("updates per second", "SAC updates per second, all members together"),
    "imagined_per_s": Number("imagined steps per second"),
}


def of(name: str) -> Number:
    """What is known of the number that the log calls `name`."""
    return NUMBERS.get(name, Number(name))
