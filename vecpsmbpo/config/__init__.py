"""From a command line, a keyword call or a run directory to `Settings`: every mistake becomes one line."""

from vecpsmbpo.config.choices import GROUPS, closest, env_options, options
from vecpsmbpo.config.composing import compose, compose_point, for_hydra, from_tree, hydra_errors
from vecpsmbpo.config.evaluation import EVALUATION, for_evaluation
from vecpsmbpo.config.overrides import chosen, parse
from vecpsmbpo.config.resuming import resolve
from vecpsmbpo.config.spelling import as_override, overrides_of
from vecpsmbpo.config.stored import CONFIG_FILE, from_record, load, save

__all__ = [
    "CONFIG_FILE",
    "EVALUATION",
    "GROUPS",
    "as_override",
    "chosen",
    "closest",
    "compose",
    "compose_point",
    "env_options",
    "for_evaluation",
    "for_hydra",
    "from_record",
    "from_tree",
    "hydra_errors",
    "load",
    "options",
    "overrides_of",
    "parse",
    "resolve",
    "save",
]
