"""How checks of `npa-envs stress` are registered and run; their results, limits and record."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Literal

import torch

from npa_envs.errors import NPAError, suggest
from npa_envs.measure.benchmark_records import Record, aligned, as_objects, time_limit
from npa_envs.rule.files import load_rule, rule_digest

Verdict = Literal["pass", "fail", "range", "skipped", ""]

GROUPS = {
    "geometry": "where particles lie: forwards and backwards, against a float64 reference",
    "values": "what states hold: tiny, huge, infinite, no number",
    "time": "every shipped rule for 100 000 steps",
    "gradients": "how gradients grow with the steps; finite differences; float32's errors",
    "precision": "order, batches, repetitions, CUDA graphs",
}
"""Groups of checks by name, in the order in which they run, with what each is about."""


class Skipped(Exception):
    """Raised by a check that cannot run on this device or for this rule; the message says why."""


@dataclass(frozen=True)
class CheckResult:
    """Measured numbers by name (`metrics`), upper limits of some of them, and the verdict."""

    metrics: Mapping[str, float] = field(default_factory=dict)
    limits: Mapping[str, float] = field(default_factory=dict)
    holds: str = ""
    """The range in which the library is right, as text; "" if the check measures none."""
    note: str = ""
    """Why it was skipped, its error, or a remark."""
    verdict: Verdict = ""
    """By default "fail" if a metric with a limit is above it, missing or NaN, else "range" if
    `holds` is given, or "pass"."""
    name: str = ""
    """Name of the check; `run_check` sets this field and those below."""
    expected: str = ""
    seconds: float = 0.0
    """Duration [s]."""
    weights: str = ""
    """Hash of the weights of the check's rule (`rule_digest`)."""

    def __post_init__(self) -> None:
        # Comparisons with NaN are false.
        within = all(self.metrics.get(key, math.nan) <= limit for key, limit in self.limits.items())
        default = "range" if self.holds else "pass"
        object.__setattr__(self, "verdict", self.verdict or (default if within else "fail"))

    def fraction(self, name: str) -> float:
        """Return a metric / its limit; NaN if it is missing; 0 / 0 is 0, others / 0 infinite."""
        value, limit = self.metrics.get(name, math.nan), self.limits[name]
        if limit == 0.0:
            return value if value == 0.0 or math.isnan(value) else math.inf
        return value / limit

    def worst(self) -> str:
        """Return the metric with the largest `fraction`, or NaN, as text; "" without limits."""
        if not self.limits:
            return ""
        fractions = {name: self.fraction(name) for name in self.limits}
        name = max(fractions, key=lambda name: (math.isnan(fractions[name]), fractions[name]))
        value = self.metrics.get(name, math.nan)
        return f"{name} {value:.2g} (at most {self.limits[name]:.2g})"


@dataclass
class CheckSession:
    """Options of one run of `npa-envs stress`, and what its checks share."""

    device: torch.device
    quick: bool = False
    """Whether worlds are small and steps are few."""
    cache: dict[Any, Any] = field(default_factory=dict)
    """Rules and tasks that several checks use (`rule_worlds`)."""

    @property
    def cuda(self) -> bool:
        """Whether the device is a CUDA device."""
        return self.device.type == "cuda"

    def generator(self, number: int = 0) -> torch.Generator:
        """Return a new random generator on the session's device, with the seed `number`."""
        return torch.Generator(self.device).manual_seed(number)


Run = Callable[..., CheckResult]
"""Measures a hard case. Takes a rule's name or a case's dimension and boundary, and the session."""


@dataclass(frozen=True)
class Check:
    """A hard case: a function that measures it, and the expected result in a sentence."""

    name: str
    """GROUP/CASE, such as "geometry/clump/2d/open"."""
    expected: str
    run: Run
    """Called with the session."""
    rule: str = ""
    """Name of the shipped rule, or file of the rule, that is checked; "" if no rule is."""

    @property
    def group(self) -> str:
        """The name up to the first slash, one of `GROUPS`."""
        return self.name.partition("/")[0]

    @property
    def weights_digest(self) -> str:
        """Hash of the rule's weights (`rule_digest`), "" without a rule."""
        return rule_digest(load_rule(self.rule)) if self.rule else ""


CHECKS: list[Check] = []
"""Registered checks that need no rule; those of scenes are made by `scene_checks`."""

RULE_CHECKS: list[Check] = []
"""Registered checks whose function takes a rule's name: `all_checks` makes one for each rule."""


LABELS = {2: "2d", 3: "3d", False: "open", True: "periodic"}
"""How names of checks show the space dimension, and whether the box is periodic."""


def check(
    name: str, *cases: int | tuple[int, bool], registry: list[Check] = CHECKS
) -> Callable[[Run], Run]:
    """Return a decorator that adds the check `name` to `registry`, or one check for each case.

    A case is a space dimension (NAME/2d), or a pair of it and whether the box is periodic
    (NAME/2d/open). The docstring of the decorated function is the check's expected result.
    """

    def add(run: Run) -> Run:
        expected = " ".join((run.__doc__ or "").split()).removesuffix(".")
        for case in cases or ((),):
            arguments = case if isinstance(case, tuple) else (case,)
            full_name = "/".join([name, *(LABELS[argument] for argument in arguments)])
            registry.append(Check(full_name, expected, partial(run, *arguments)))
        return run

    return add


def chosen_checks(checks: Sequence[Check], names: Sequence[str]) -> list[Check]:
    """Return the checks whose group, name or beginning of a name is in `names`; default: all."""

    def selects(name: str, check: Check) -> bool:
        return f"{check.name}/".startswith(f"{name.rstrip('/')}/")

    for name in names:
        if not any(selects(name, check) for check in checks):
            known = [*GROUPS, *(check.name for check in checks)]
            raise NPAError(f"unknown check {name!r}: {suggest(name, known)}")
    return [c for c in checks if not names or any(selects(name, c) for name in names)]


class StressRecord(Record[CheckResult]):
    """The results of checks and their JSON file, where metrics are called "figures"."""

    command = "stress"

    def content(self) -> dict[str, Any]:
        """Return the results of checks and their number by verdict, for JSON; NaN becomes "nan"."""
        checks = as_objects(self.rows)
        for fields in checks:
            fields["figures"] = fields.pop("metrics")
        return {"counts": self.counts(), "checks": _json_values(checks)}

    def parse(self, content: dict[str, Any]) -> list[CheckResult]:
        """Return the results that a record file's JSON object has, to resume a stopped run."""
        for fields in content["checks"]:
            for name, key in (("metrics", "figures"), ("limits", "limits")):
                fields[name] = {inner: float(value) for inner, value in fields.pop(key).items()}
        return [CheckResult(**fields) for fields in content["checks"]]

    def store(self, result: CheckResult) -> None:
        """Add a result, or replace the result of the same check, and write the file."""
        self.rows = [*({row.name: row for row in self.rows} | {result.name: result}).values()]
        self.write()

    def result_of(self, check: Check) -> CheckResult | None:
        """Return a check's stored result; None if there is none, or only of other weights."""
        digest = check.weights_digest
        rows = (row for row in self.rows if row.name == check.name and row.weights == digest)
        return next(rows, None)

    def is_done(self, check: Check) -> bool:
        """Return whether a check has passed, so that a resumed run need not repeat it."""
        result = self.result_of(check)
        return result is not None and result.verdict in ("pass", "range")

    def counts(self) -> dict[str, int]:
        """Return the number of checks with each verdict."""
        counts = Counter(result.verdict for result in self.rows)
        return {verdict: counts[verdict] for verdict in ("pass", "range", "fail", "skipped")}

    def text(self) -> str:
        """Return a table of each group, what failed checks expected, and the counts, as text."""
        parts = []
        groups: dict[str, list[CheckResult]] = {}
        for result in self.rows:
            groups.setdefault(result.name.partition("/")[0], []).append(result)
        for results in groups.values():
            texts = [result.holds or result.worst() or result.note for result in results]
            width = max(map(len, texts))
            lines = [["check", "verdict", "seconds", "found"]]
            for result, text in zip(results, texts, strict=True):
                seconds = f"{round(result.seconds, 2):.4g}"
                lines.append([result.name, result.verdict, seconds, text.ljust(width)])
            parts.append("\n".join(aligned(lines)))
        parts += [
            f"{result.name} failed: {result.worst() or result.note}\n  expected: {result.expected}"
            + (f"\n  {result.note}" if result.note and result.worst() else "")
            for result in self.rows
            if result.verdict == "fail"
        ]
        counts = ", ".join(f"{count} {verdict}" for verdict, count in self.counts().items())
        return "\n\n".join([*parts, counts])


def _json_values(value: Any) -> Any:
    """Return nested dicts and lists, in which infinite numbers and NaN are replaced by text."""
    if isinstance(value, Mapping):
        return {key: _json_values(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [_json_values(inner) for inner in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def run_checks(
    checks: Sequence[Check],
    session: CheckSession,
    record: StressRecord,
    *,
    max_seconds: float | None = None,
    progress: Callable[[int], None] = lambda done: None,
) -> None:
    """Run the checks that have not passed before, and store their results in the record.

    After `max_seconds` no further check starts, and checks without a result are stored as skipped;
    None: no limit. After each check `progress` is called with 1.
    """
    time_is_up = time_limit(max_seconds)
    for check in checks:
        if not record.is_done(check):
            if not time_is_up():
                record.store(run_check(check, session))
            elif record.result_of(check) is None:
                skipped = CheckResult(verdict="skipped", note="no time was left for it")
                record.store(replace(skipped, name=check.name, expected=check.expected))
        progress(1)


def run_check(check: Check, session: CheckSession) -> CheckResult:
    """Run a check and return its result: "fail" on an error, "skipped" if memory runs out."""
    digest, begin = check.weights_digest, time.perf_counter()
    try:
        result = check.run(session)
    except Skipped as reason:
        result = CheckResult(verdict="skipped", note=str(reason))
    except torch.OutOfMemoryError:
        result = CheckResult(verdict="skipped", note="not enough memory")
    except Exception as error:
        # Any error is a failure of the check.
        note = f"{type(error).__name__}: {' '.join(str(error).split())}"
        result = CheckResult(verdict="fail", note=note)
    seconds = time.perf_counter() - begin
    return replace(
        result, name=check.name, expected=check.expected, seconds=seconds, weights=digest
    )
