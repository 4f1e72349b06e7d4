"""`vecpsmbpo theory`: computes what this package holds; prints tables, writes a CSV file and a figure."""

import csv
import io
from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from vecpsmbpo import arguments
from vecpsmbpo.look import files, working
from vecpsmbpo.settings import SettingError
from vecpsmbpo.theory import example, tabular
from vecpsmbpo.theory.tabular import Belief, Estimate

Array = np.ndarray

STEPS = 2
REAL_RATIOS = (0.0, 0.25, 0.5, 0.75, 1.0)
CURVE = np.linspace(0, 1, 21)
FINE = np.linspace(0, 1, 1001)


OPTIONS = {
    "out": arguments.out("where theory.csv and theory.svg go", "theory"),
    "seed": arguments.whole("of the random MDPs and of the luck in them", 0, at_most=2**31 - 1),
    # Beyond 500 posteriors would be narrower than two cells of `tabular.GRID`.
    "episodes": arguments.whole("K, of each MDP", 150, at_least=2, at_most=500),
    "runs": arguments.whole("R, MDPs drawn from the prior", 100, at_least=2, at_most=100_000),
}


class Options(NamedTuple):
    """What the command was told: `OPTIONS`."""

    out: Path
    seed: int
    episodes: int
    runs: int


class Arm(NamedTuple):
    """One algorithm's summary.

    Attributes:
        belief: the name of q(M|D).
        real_ratio: λ.
        totals: regret of each run, [R].
        regret: cumulative, mean over runs, [K].
        error: its standard error, [K].
        late: regret per episode over the last tenth.
        kl: d_KL(q_k | p_k), mean over runs and episodes.
        terms: Theorem 1's second term up to each episode, [K].
        second_term: the last of them.
    """

    belief: str
    real_ratio: float
    totals: Array
    regret: Array
    error: Array
    late: Estimate
    kl: float
    terms: Array
    second_term: Estimate

    @classmethod
    def of(cls, belief: str, real_ratio: float, outcome: tabular.Outcome) -> "Arm":
        cumulative = outcome.regret.cumsum(axis=0)
        episodes, runs = cumulative.shape
        late = outcome.regret[-max(episodes // 10, 1) :].mean(axis=0)
        terms, second_term = tabular.second_term(outcome.kl, STEPS)
        error = cumulative.std(axis=1, ddof=1) / np.sqrt(runs)
        return cls(
            belief,
            real_ratio,
            totals=cumulative[-1],
            regret=cumulative.mean(axis=1),
            error=error,
            late=Estimate.of(late),
            kl=float(outcome.kl.mean()),
            terms=terms,
            second_term=second_term,
        )


class Experiment(NamedTuple):
    """The tabular experiment.

    Attributes:
        arms: by name of the belief, one for every λ of `REAL_RATIOS`. The last, λ = 1, reads no model and is the same
            in all.
        curves: d_KL(q(π|D, λ) | p(π|D)) on the same data, by name of the belief, [L] over `CURVE`. The data is what
            exact PSRL has at the end.
    """

    arms: dict[str, list[Arm]]
    curves: dict[str, Array]

    @property
    def exact(self) -> Arm:
        """PSRL with exact inference."""
        return self.arms[tabular.EXACT.name][0]


def run(words: Sequence[str]) -> int:
    """Runs the command; prints tables and writes `theory.csv` and `theory.svg`. The exit status.

    Raises:
        SettingError: a mistake in `words`, or `out` cannot be written.
    """
    alone, values = arguments.parse("theory", words, OPTIONS)
    if alone:
        raise SettingError(f"{alone[0]}: must be name=value")
    options = Options(**values)
    folder = options.out
    console = Console(highlight=False, width=118)
    for name in ("theory.csv", "theory.svg"):
        files.check_writable(folder / name)
    console.print(_example_table(), "", _lambda_table(), "", sep="\n")
    experiment = compute(options)
    console.print(_arms_table(experiment, options), "", _best_table(experiment), "", sep="\n")
    console.print(_notes(experiment, options), markup=False)
    files.write_text(folder / "theory.csv", _as_csv(experiment))
    _draw(folder / "theory.svg", experiment)
    console.print(f"written: {folder / 'theory.csv'}, {folder / 'theory.svg'}", markup=False)
    return 0


def compute(options: Options) -> Experiment:
    """Runs the tabular experiment: every belief at every λ, in the same MDPs with the same luck."""
    world = tabular.World.draw(options.seed, runs=options.runs, episodes=options.episodes, steps=STEPS)
    truth = tabular.Marginals(tabular.EXACT, 0.0, options.episodes)
    beliefs = (tabular.EXACT, *tabular.WRONG)
    tasks: list[tuple[Belief, float]] = [(belief, ratio) for belief in beliefs for ratio in REAL_RATIOS[:-1]]
    tasks.append((tabular.EXACT, 1.0))
    data, arms = None, []
    for belief, ratio in working.steps(tasks, "PSRL"):
        outcome = tabular.psrl(world, belief, ratio, truth)
        arms.append(Arm.of(belief.name, ratio, outcome))
        data = outcome.counts if data is None else data  # the first task is exact PSRL
    assert data is not None
    *below_one, one = arms
    grouped = {belief.name: [arm for arm in below_one if arm.belief == belief.name] + [one] for belief in beliefs}
    return Experiment(grouped, {belief.name: tabular.lambda_curve(data, belief, CURVE) for belief in beliefs})


def _example_table() -> Table:
    table = Table(title="Example 1 and Proposition 1: q(M|D) = (0, 1), wrong", title_justify="left")
    for column in ("p(M|D) of", "p(π|D)", "q^δ(π|D)", "KL(q^δ | p)", "largest KL", "best q(π|M_2)", "its KL"):
        table.add_column(column)
    optimal, models = example.OPTIMAL, example.WRONG_MODELS
    degenerate = example.marginal(optimal, models)
    for name, p in (("equation 10", example.EQUATION_10), ("the text", example.TEXT)):
        best = example.best_conditional(optimal, models, p)
        best_kl = example.kl(example.marginal(best, models), p)
        numbers = (_log(float(example.kl(degenerate, p))), _log(example.largest_kl(p)))
        table.add_row(name, _vector(p), _vector(degenerate), *numbers, _vector(best[:, 1]), f"{best_kl:.4f}")
    table.caption = (
        "The paper's text has p(M_1|D) = 1/3 and p(M_2|D) = 2/3, its equation 10 the reverse. Equations 11 and 12 "
        "(KL = log 3, the largest there is) hold for equation 10. The best KL is 0 for every q(M|D): q(π|M) = p(π|D) "
        "for every M attains it."
    )
    table.caption_justify = "left"
    return table


def _lambda_table() -> Table:
    table = Table(title="Proposition 2 in Example 1 (equation 10): KL(q(π|D, λ) | p(π|D))", title_justify="left")
    for column in ("case", "λ = 0: q^δ", "least", "at λ", "λ = 1: q(π|D)"):
        table.add_column(column, justify="left" if column == "case" else "right")
    for case in example.LAMBDA_CASES:
        curve = _example_curve(case, FINE)
        least = int(curve.argmin())
        numbers = (f"{curve[0]:.4f}", f"{curve[least]:.4f}", f"{FINE[least]:.3f}", f"{curve[-1]:.4f}")
        table.add_row(case.name, *numbers)
    table.caption = "Between its ends, where the paper leaves q(π|M, D, λ) open: (1 - λ) δ(π|M) + λ q(π|D)."
    table.caption_justify = "left"
    return table


def _arms_table(experiment: Experiment, options: Options) -> Table:
    title = f"PSRL in {options.runs} random MDPs, {options.episodes} episodes of {STEPS} steps: mean ± standard error"
    table = Table(title=title, title_justify="left")
    table.add_column("q(M|D)")
    for column in ("λ", "regret", "minus exact PSRL's", "late, an episode", "mean KL(q_k | p_k)", "second term"):
        table.add_column(column, justify="right")
    for arm in _distinct(experiment):
        name = arm.belief if arm.real_ratio < 1 else "none"
        difference = "" if arm is experiment.exact else _plus_minus(Estimate.of(arm.totals - experiment.exact.totals))
        regret = Estimate(arm.regret[-1], arm.error[-1])
        cells = (_plus_minus(regret), difference, _plus_minus(arm.late, 4), f"{arm.kl:.3f}")
        last = arm.real_ratio in REAL_RATIOS[-2:]
        table.add_row(name, f"{arm.real_ratio:g}", *cells, _plus_minus(arm.second_term, 0), end_section=last)
    meanings = "; ".join(f"{belief.name}: {belief.meaning}" for belief in (tabular.EXACT, *tabular.WRONG))
    table.caption = f"{meanings}. λ = 1 reads no model. Late: over the last tenth of the episodes."
    table.caption_justify = "left"
    return table


def _best_table(experiment: Experiment) -> Table:
    table = Table(
        title="The best λ of those tried, and the λ curve of Proposition 2 on the same data", title_justify="left"
    )
    table.add_column("q(M|D)")
    for column in ("regret", "minus that at λ = 0", "second term", "KL, same data", "KL there", "KL at λ = 0"):
        table.add_column(column, justify="right")
    for name, arms in experiment.arms.items():
        best = min(arms, key=lambda arm: arm.regret[-1])
        saved = "" if best is arms[0] else _plus_minus(Estimate.of(best.totals - arms[0].totals))
        bound = min(arms, key=lambda arm: arm.terms[-1])
        curve = experiment.curves[name]
        least = int(curve.argmin())
        numbers = (f"{CURVE[least]:.3g}", f"{curve[least]:.3f}", f"{curve[0]:.3f}")
        table.add_row(name, f"{best.real_ratio:g}", saved, f"{bound.real_ratio:g}", *numbers)
    table.caption = "The same data: what exact PSRL has collected at the end."
    table.caption_justify = "left"
    return table


def _notes(experiment: Experiment, options: Options) -> str:
    """What the numbers say, from the numbers."""
    lines = []
    for belief in tabular.WRONG:
        degenerate = experiment.arms[belief.name][0]
        difference = Estimate.of(degenerate.totals - experiment.exact.totals)
        if abs(difference.value) < 2 * difference.error:
            verdict = "cannot be told from exact PSRL's (within two standard errors)"
        else:
            verdict = "is above exact PSRL's" if difference.value > 0 else "is below exact PSRL's"
        lines.append(f"q^δ, {belief.name}: its regret {verdict}.")
    first = tabular.first_term(options.episodes, STEPS)
    lines.append(
        f"Theorem 1's first term: {first:.0f} (C at most |Π| = {len(tabular.policies(STEPS))}). An episode's regret is "
        f"at most 1, so beyond {options.episodes} the bound says nothing."
    )
    return "\n".join(lines)


def _draw(path: Path, experiment: Experiment) -> None:
    """Writes the figure."""
    from vecpsmbpo.look.lines import Panel, Series, write  # here, not above: mistakes answer before matplotlib is there

    names = list(experiment.arms)
    episode = np.arange(1, len(experiment.exact.regret) + 1)
    ratios = np.array(REAL_RATIOS)

    def over_episodes(name: str, arm: Arm) -> Series:
        return Series(name, episode, arm.regret, arm.error)

    wide = tabular.WRONG[0].name
    degenerate = [over_episodes(f"{name}, λ = 0", experiment.arms[name][0]) for name in names]
    degenerate.append(over_episodes("no model, λ = 1", experiment.arms[wide][-1]))
    sweeps = [
        Series(name, ratios, np.array([arm.regret[-1] for arm in arms]), np.array([arm.error[-1] for arm in arms]))
        for name, arms in experiment.arms.items()
    ]
    seconds = [[arm.second_term for arm in arms] for arms in experiment.arms.values()]
    terms = [
        Series(name, ratios, np.array([term.value for term in row]), np.array([term.error for term in row]))
        for name, row in zip(names, seconds, strict=True)
    ]
    cases = [Series(case.name, CURVE, _example_curve(case, CURVE)) for case in example.LAMBDA_CASES]
    curves = [Series(name, CURVE, curve) for name, curve in experiment.curves.items()]
    mixed = [over_episodes(f"λ = {arm.real_ratio:g}", arm) for arm in experiment.arms[wide]]
    panels = [
        Panel("Proposition 2 in Example 1", "λ", "KL(q | p)", cases),
        Panel("Proposition 2, tabular, same data", "λ", "KL(q | p)", curves),
        Panel("Regret of the degenerate posterior", "episode", "regret", degenerate),
        Panel("Regret at the end", "λ", "regret", sweeps),
        Panel("Theorem 1's second term", "λ", "2 H R_max Σ √E[KL]", terms),
        Panel(f"Regret where q(M|D) is {wide}", "episode", "regret", mixed),
    ]
    write(path, "The theory of posterior sampling", panels, columns=3)


def _as_csv(experiment: Experiment) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("part", "case", "real_ratio", "episode", "quantity", "value", "standard_error"))
    for *labels, value, error in _lines(experiment):
        writer.writerow((*labels, f"{value:.6g}", "" if error is None else f"{error:.6g}"))
    return text.getvalue()


def _lines(experiment: Experiment) -> Iterator[tuple]:
    degenerate = example.marginal(example.OPTIMAL, example.WRONG_MODELS)
    for name, p in (("equation 10", example.EQUATION_10), ("text", example.TEXT)):
        best = example.marginal(
            example.best_conditional(example.OPTIMAL, example.WRONG_MODELS, p), example.WRONG_MODELS
        )
        yield "example_1", name, "", "", "kl_degenerate", example.kl(degenerate, p), None
        yield "example_1", name, "", "", "kl_largest", example.largest_kl(p), None
        yield "example_1", name, "", "", "kl_best", example.kl(best, p), None
    for case in example.LAMBDA_CASES:
        for ratio, value in zip(CURVE, _example_curve(case, CURVE), strict=True):
            yield "proposition_2_example", case.name, f"{ratio:g}", "", "kl", value, None
    for name, curve in experiment.curves.items():
        for ratio, value in zip(CURVE, curve, strict=True):
            yield "proposition_2_tabular", name, f"{ratio:g}", "", "kl", value, None
    for arm in _distinct(experiment):
        labels = ("tabular", arm.belief if arm.real_ratio < 1 else "none", f"{arm.real_ratio:g}")
        for episode, row in enumerate(zip(arm.regret, arm.error, arm.terms, strict=True), start=1):
            yield *labels, episode, "regret", *row[:2]
            yield *labels, episode, "second_term", row[2], None
        yield *labels, "", "second_term", *arm.second_term
        yield *labels, "", "late_regret", *arm.late


def _distinct(experiment: Experiment) -> list[Arm]:
    """Every arm once, the one at λ = 1 last."""
    groups = list(experiment.arms.values())
    return [arm for arms in groups for arm in arms[:-1]] + groups[0][-1:]


def _example_curve(case: example.LambdaCase, ratios: Array) -> Array:
    return example.lambda_curve(example.OPTIMAL, case.models, case.data, example.EQUATION_10, ratios)


def _vector(values: Array) -> str:
    return "(" + ", ".join(str(Fraction(float(value)).limit_denominator(1000)) for value in values) + ")"


def _log(value: float) -> str:
    """1.0986 = log 3."""
    return f"{value:.4f} = log {Fraction(float(np.exp(value))).limit_denominator(1000)}"


def _plus_minus(estimate: Estimate, digits: int = 2) -> str:
    return f"{estimate.value:.{digits}f} ± {estimate.error:.{digits}f}"
