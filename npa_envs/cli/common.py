"""What several commands share: options, output folders, checks of options, progress bars."""

from __future__ import annotations

import argparse
import contextlib
import inspect
import io
import json
import math
import re
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import tyro
from tqdm import tqdm

from npa_envs.atomic_files import NEARLY_FULL_BYTES, made_folder
from npa_envs.errors import NPAError, check_known, suggest

if TYPE_CHECKING:
    import torch

    from npa_envs.agents.learning import Problem

OptionsT = TypeVar("OptionsT")


def parse_options(
    cls: type[OptionsT],
    command: str,
    arguments: Sequence[str],
    *,
    description: str | None = None,
    default: OptionsT | None = None,
) -> OptionsT:
    """Parse a command's arguments to the dataclass `cls`; options not given are as in `default`.

    Ends the process after `--help`; raises NPAError for a wrong argument and where the dataclass
    does. The help begins with `description`, by default the dataclass's docstring.
    """
    kwargs: dict[str, Any] = {} if default is None else {"default": default}
    kwargs["config"] = tyro.conf.OmitArgPrefixes, tyro.conf.DisallowNone, tyro.conf.SuppressFixed
    try:
        # Kept back: tyro names Python's fields, and suggests an option only for very similar names.
        with contextlib.redirect_stderr(io.StringIO()) as said:
            options: OptionsT = tyro.cli(
                cls,
                prog=f"npa-envs {command}",
                description=description or inspect.getdoc(cls),
                args=arguments,
                **kwargs,
            )
    except SystemExit as end:
        if not end.code:
            raise
        typed = [word for word in arguments if word.startswith("--")]
        given = {word[2:].partition("=")[0].replace("_", "-"): word for word in typed}
        cause: BaseException | None = end
        while cause is not None and not isinstance(cause, NPAError):
            cause = cause.__context__
        if cause is not None:
            message, field = str(cause), str(cause).partition(" ")[0]
            if word := given.get(field.replace("_", "-")):
                # Named as typed; tuples stay as Python writes them.
                pattern = rf"^{field}\b|\b{field}=(?=[\w.-])"
                message = re.sub(pattern, f"{word.partition('=')[0]} ", message)
            raise NPAError(message) from end
        with contextlib.redirect_stdout(io.StringIO()) as text, contextlib.suppress(SystemExit):
            tyro.cli(cls, args=["--help"], **kwargs)
        known = set(re.findall("--([a-z][a-z0-9-]*)", text.getvalue()))
        # Options by the first word of what they are, such as "Steps".
        meant = re.findall(r"(?ms)^. --([a-z][a-z0-9-]*).*?\b([A-Z][a-z]+)\b", text.getvalue())
        by_word = {word.lower(): name for name, word in reversed(meant)}
        for name, word in given.items():
            if name not in known:
                nearest = suggest(by_word.get(name, name), known).partition("known: ")[0]
                hint = nearest.replace("'", "'--", 1)
                raise NPAError(f"unknown option {word!r}: {hint or 'see --help'}") from end
        raise NPAError(f"{_first_message(said.getvalue())}: see npa-envs {command} --help") from end
    return options


def _first_message(said: str) -> str:
    """Return the first message in the frame that tyro prints for wrong arguments, as one line."""
    # After the title; lines of dashes separate the parts.
    parts = re.split("[─-]{9,}", said.partition("\n")[2])
    message = next(filter(None, (" ".join(re.sub("[│╰╯]", " ", part).split()) for part in parts)))
    for pattern, plain in (
        (r"Error parsing (\S+): .*invalid literal.*: (.*)", r"\1 must be a whole number, got \2"),
        (r"Error parsing (\S+): .*could not convert.*: (.*)", r"\1 must be a number, got \2"),
        (r"Error parsing (\S+): .*arguments:? \[(.*?)\].*", r"\1 cannot be \2"),
        (r"Missing value for argument '(\S+)'.*", r"\1 needs a value"),
        (r"invalid choice (.*) for argument '(\S+)'\. Expected one of \((.*?),?\)\.",
         r"\2 must be one of \3, got \1"),
        (r"Missing from .*?: (\S+) .*", r"\1 is missing"),
    ):  # fmt: skip
        message = re.sub(pattern, plain, message)
    return message


@dataclass(frozen=True, kw_only=True)
class DeviceOptions:
    """Options of commands that need a device."""

    device: str = "cpu"
    """Where to run: cpu, cuda, cuda:1."""

    def checked_device(self) -> torch.device:
        """Return `device`; raise NPAError if this machine has no such device."""
        from npa_envs.checks import check_device

        return check_device(self.device)


@dataclass(frozen=True, kw_only=True)
class RunOptions(DeviceOptions):
    """Options of commands that run worlds."""

    progress: bool = True
    """Show a progress bar."""


@dataclass(frozen=True, kw_only=True)
class RuleOptions(RunOptions):
    """Options of commands that run one rule: the rule, its world and the device."""

    rule: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="RULE")]
    """A shipped rule (`npa-envs list`), the folder of a run, a file of this package or of the
    paper's authors (.safetensors, .pth), or a rule of their web demo (models.json#name)."""
    target: str | None = None
    """The target to measure against; default: the one that the rule was trained on."""
    loss: str | None = None
    """Textures only: the loss to measure by (`npa-envs list`); default: as trained."""
    data: str | None = None
    """Point clouds only: "digits", "mnist" or a folder of IDX files; default: as trained."""
    particle_count: int | None = None
    """Particles N; default: as trained."""
    eps: float | None = None
    """Perception radius [length units]; default: as trained."""
    update_prob: float | None = None
    """Probability of each particle's update in a step; default: as trained."""

    @property
    def world(self) -> dict[str, Any]:
        """Options that change the rule's task and world, as keywords of `task_of_rule`."""
        names = ("target", "loss", "data", "particle_count", "eps", "update_prob")
        return {name: getattr(self, name) for name in names}


def named_rules(arguments: Iterable[str]) -> dict[str, str]:
    """Return sources for `load_rule` by rule's name, of names, files or run folders."""
    from npa_envs.rule.files import preset_rules, rule_name, shipped_rules

    arguments = list(arguments)
    known = list(dict.fromkeys([*shipped_rules(), *preset_rules()]))
    others = [word for word in arguments if word not in known]
    files = [word for word in others if word.endswith(".safetensors") or Path(word).is_dir()]
    names = [word for word in arguments if word not in files]
    sources = {name: name for name in (chosen_names("rule", names, known) if names else ())}
    for source in files:
        name = rule_name(source)
        if sources.setdefault(name, source) != source:
            raise NPAError(
                f"rules must have different names, but {sources[name]!r} and {source!r} are "
                f"both called {name!r}: rename a file or folder, or measure them one by one, each "
                "with its own --out"
            )
    return sources


def check_has_rule(name: str) -> None:
    """Raise NPAError if `name` is a built-in target for which no rule is shipped."""
    from npa_envs.rule.files import preset_rules, shipped_rules
    from npa_envs.training import TASKS

    if Path(name).exists() or name in {**shipped_rules(), **preset_rules()}:
        return
    for task, entry in TASKS.items():
        if name in entry.targets():
            train = f"train one with npa-envs train {task} --target {name} --out runs/{name}"
            raise NPAError(f"{name} is a target, and no rule for it is shipped: {train}")


def duration(seconds: float) -> str:
    """Return a time [s] as rounded text, for example "3 minutes"."""
    for unit, size in (("hours", 3600.0), ("minutes", 60.0)):
        if seconds >= 1.5 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{max(seconds, 1.0):.0f} s"


def writable_folder(path: Path, name: str = "out") -> Path:
    """Return a folder, made where it is missing; raise NPAError for `name` if it takes no files."""
    must = "created"
    try:
        with made_folder(path):
            must = "written to"
            with tempfile.TemporaryFile(dir=path) as file:
                # A full disk still makes files, without content.
                file.write(bytes(NEARLY_FULL_BYTES))
    except OSError as error:
        raise NPAError(
            f"{name} must be a folder that can be {must}, got {str(path)!r} "
            f"({error.strerror or error}): choose another one"
        ) from error
    return path


@dataclass(frozen=True, kw_only=True)
class SharedRunOptions:
    """Options of runs that are resumed, and shared by processes."""

    processes: int | None = None
    """Processes that share the run, on CUDA one GPU each; by default 1, but 2 for small batches of
    `train` on a CPU with enough cores. `torchrun --nproc-per-node=4 -m npa_envs ...` does the
    same."""
    gpus: int | None = None
    """GPUs that share the run: `--gpus 4` means `--device cuda --processes 4`."""
    resume: bool = False
    """Continue from the checkpoint in the folder `--out`; `train` also takes its configuration from
    there. `--resume auto` starts a new run if there is no checkpoint."""
    overwrite: bool = False
    """Start again even if the folder `--out` contains a run; the run's files are removed."""


@dataclass(frozen=True, kw_only=True)
class MeasureOptions(RunOptions):
    """Options of the commands that measure and keep records."""

    max_seconds: float = math.inf
    """Start nothing more after this time [s]; what is done is kept."""
    threads: int = 1
    """CPU threads of torch and the kernels in each run; they change times, not other results."""
    commit: str | None = None
    """The measured commit, for the record; default: that of the checkout."""


def check_numbers(options: Any, **least: int) -> None:
    """Check that options, unless None, are at least as in `least`, and `max_seconds` above 0."""
    for name, smallest in least.items():
        value, option = getattr(options, name), f"--{name.replace('_', '-')}"
        if value is not None and value < smallest:
            raise NPAError(f"{option} must be at least {smallest}, got {value}: try {smallest}")
    seconds = getattr(options, "max_seconds", math.inf)
    if not seconds > 0.0:
        raise NPAError(f"--max-seconds must be positive, got {seconds}: leave it out for no limit")


def named_values(name: str, arguments: Iterable[str]) -> dict[str, Any]:
    """Parse arguments NAME=VALUE to values by name; a value is read as JSON, or else stays text.

    `name` is the option that has these arguments, for errors.
    """
    values: dict[str, Any] = {}
    for word in arguments:
        key, mark, value = word.partition("=")
        if not mark:
            raise NPAError(f"{name} must be NAME=VALUE, got {word!r}: target=heart")
        try:
            values[key] = json.loads(value)
        except ValueError:
            values[key] = value
    return values


def problem_of(options: Any, num_envs: int, steps: int | None = None) -> Problem:
    """Return the problem to learn `options.env`, with episodes of `steps`; None: as registered."""
    from npa_envs.agents.learning.problem import Problem, registration_of

    steps = registration_of(options.env).steps if steps is None else steps
    keywords = named_values("keywords", options.keywords)
    return Problem(env_id=options.env, keywords=keywords, episode_steps=steps, num_envs=num_envs)


def first_options(arguments: Sequence[str]) -> argparse.Namespace:
    """Return the options that tyro's defaults depend on, such as `preset`, and all `words`."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    for name in ("preset", "device", "gpus"):
        parser.add_argument(f"--{name}")
    for name in ("config", "out"):
        parser.add_argument(f"--{name}", type=Path)
    parser.add_argument("--resume", nargs="?", const=True, choices=("auto",))
    parser.add_argument("--overwrite", action="store_true")
    try:
        return parser.parse_known_args(arguments, argparse.Namespace(words=[*arguments]))[0]
    except argparse.ArgumentError as error:
        raise NPAError(f"{error.argument_name}: {error.message}") from error


def resolve_run(arguments: Sequence[str], out_of: Callable[[Any], Path]) -> argparse.Namespace:
    """Return the options of `first_options`, which choose the defaults of others, and all `words`.

    `--gpus` without a device adds `--device cuda`. `--resume auto` becomes `--resume` if the run's
    folder, which `out_of` returns for these options, has a checkpoint; otherwise it is removed.
    """
    first = first_options(arguments)
    if first.gpus is not None and first.device is None:
        first.device = "cuda"
        first.words += ["--device", "cuda"]
    if first.resume is not None:
        from npa_envs.training.run_folder import RunFolder, check_choice

        check_choice(resume=True, overwrite=first.overwrite)
        if first.resume == "auto":
            if "--resume=auto" in first.words:
                first.words.remove("--resume=auto")
            else:
                index = first.words.index("--resume")
                del first.words[index : index + 2]
            first.resume = None
            if RunFolder(out_of(first)).checkpoint.exists():
                first.resume = True
                first.words.append("--resume")
    return first


def chosen_names(noun: str, names: Sequence[str], known: Iterable[str]) -> list[str]:
    """Return `names` in the order of `known`; all of `known` if there are none.

    Raises NPAError for an unknown name, which it calls a `noun`.
    """
    known = list(known)
    for name in names:
        check_known(f"unknown {noun}", name, known)
    return [name for name in known if not names or name in names]


@contextlib.contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Set torch's number of CPU threads to `count` within a `with` block."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextlib.contextmanager
def progress_bar(
    total: int | None, *, show: bool, unit: str = "step"
) -> Iterator[Callable[[int], Any]]:
    """Show a progress bar of `total` units; None: their number is unknown.

    Yields a function to call with the number of units that were done since its last call.
    """
    with tqdm(total=total, disable=not show, unit=unit) as bar:
        yield bar.update


@contextlib.contextmanager
def measuring(
    options: Any, total: int | None, unit: str = "step"
) -> Iterator[Callable[[int], Any]]:
    """As `progress_bar`, also with `options.threads` CPU threads within the `with` block."""
    with (
        progress_bar(total, show=options.progress, unit=unit) as advance,
        torch_threads(options.threads),
    ):
        yield advance
