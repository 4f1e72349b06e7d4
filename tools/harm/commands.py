"""Commands with a mistake in each, for tools/faults: words, and what the environment is set to."""

WHOLE = (
    "n_models", "n_policies", "total_steps", "epoch_steps", "warmup_steps", "replay_capacity", "model_hidden_size",
    "model_patience", "rollout_starts", "imagined_capacity", "updates_per_step", "eval_episodes", "checkpoint_every",
)  # fmt: skip
REAL = ("temperature", "model_learning_rate", "policy_learning_rate", "target_entropy", "prior_scale", "trust_region")

SETTINGS = [
    *(f"{name}={wrong}" for name in WHOLE for wrong in ("1e10", "-1", "x")),
    *(f"{name}={wrong}" for name in REAL for wrong in ("1e-320", "1e39", "nan")),
    *("seed=-1", "seed=3000000000", "seed=0.5", "num_seeds=1000000000", "real_ratio=2", "discount=-1", "seed=", "=3"),
    *("env=hoper", "env=", "algo=foo", "size=huge", "recipe=x", "backend=tpu", "loggers=[x]", "report=maybe", "~seed"),
    *(
        "sweep.real_ratio=[]",
        "sweep.real_ratio=[0,0]",
        "sweep.nothing=[1]",
        "sweep=3",
        "+new=1",
        "a b c",
    ),
    *(
        "run_dir=${nosuch}",
        "~seed=0",
        f"run_dir={'x' * 300}",
        "run_dir=/proc/x/y",
        "run_dir=/dev/null/x",
        "seed=[",
        "seed='",
    ),
    *("rollout_starts=2e9", "policy_hidden_layers=2000", "eval_episodes=1e9", "run_dir='a\\b'", "run_dir=gs://b"),
    *("experiment=fig2", "hydra.nosuch=1", "env=hopper env.id=x", "n_models=1,2", "validation_ratio=0.3", "devices=-1"),
    *("distributed=maybe", "distributed=a:1/2/2"),
]

MODULES = {
    "mine": (
        "number = 5\nclass Wants:\n    def __init__(self, x): pass\ndef fails(): raise KeyError('no')\n"
        "def leaves(): raise SystemExit(0)\ndef other(): return 5\n"
    ),
    "lacks": "import nowhere_at_all",
    "raises": "raise RuntimeError('at import')",
    "syntax": "def (",
    "exits": "raise SystemExit(0)",
}
MAKES = (
    "mine:number",
    "mine:Wants",
    "mine:fails",
    "mine:leaves",
    "mine:other",
    "mine:nothing",
    "mine",
    "lacks:x",
    "raises:x",
)
MAKES += ("syntax:x", "exits:x", "os:path", "nowhere:x", ":x", "mine:")
CUSTOM = ["train", "env=custom", "size=tiny", "backend=host"]
SMALL = ["train", "env=ball_in_cup", "size=tiny", "backend=host"]

COMMANDS: list[tuple[list[str], dict[str, str]]] = [
    *((["train", *text.split(" ")], {}) for text in SETTINGS),
    *((["train", "env=gymnasium", f"env.id={wrong}"], {}) for wrong in ("5", "null", "[1,2]", "''", "Nothing-v9")),
    *(([*CUSTOM, f"env.make={make}"], {}) for make in MAKES),
    *(
        (["train", "-m", *words.split()], {})
        for words in ("seed=0,0", "hydra.nosuch=1 seed=0,1", "hydra/launcher=x seed=0,1")
    ),
    *((SMALL, {"JAX_PLATFORMS": wrong}) for wrong in ("foo", "cuda", "tpu")),
    (SMALL, {"XLA_FLAGS": "--xla_nosuch=1"}),
    (["train", "env=hoppér", "run_dir=λ"], {"PYTHONIOENCODING": "ascii"}),
    *(
        (words.split(), {})
        for words in ("trian", "eval", "eval run_dir=nowhere", "plot nowhere", "report", "envs x", "figure fig99")
    ),
]
