"""The layers: each module imports only modules of lower layers, and few libraries.

The table below is the whole rule. A new module needs a row (or lies in a folder that has one); the
libraries named are the only ones outside Python's own that its files may import, at any depth.
"""

import ast
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
MAPPED = ("envs", "wrappers", "agents")


@dataclass(frozen=True)
class Layer:
    """The height of a module and the libraries that it may use."""

    level: int
    libraries: frozenset[str]
    never: tuple[str, ...] = ()
    """Modules of lower layers that it must not import."""


def layer(level: int, libraries: str = "", never: tuple[str, ...] = ()) -> Layer:
    return Layer(level, frozenset(libraries.split()), never)


COMPUTED_NAME = "<imported by a computed name>"
INSIDES = ("npa_envs.kernels", "npa_envs.ops", "npa_envs.reference")
"""Not for users of worlds and operators, who take `npa_envs.world` and the public names."""
ORACLES = ("npa_envs.kernels", "npa_envs.reference")
LAYERS = {
    "npa_envs._module_search": Layer(0, frozenset({COMPUTED_NAME})),
    "npa_envs.errors": layer(0),
    "npa_envs.registration": layer(0, "gymnasium"),
    "npa_envs.checks": layer(1, "torch"),
    "npa_envs.devices": layer(1, "torch"),
    "npa_envs.files": layer(1),
    "npa_envs.kernel_lock": layer(0),
    "npa_envs.processes": layer(1),
    "npa_envs.runtime": layer(1, "warp"),
    "npa_envs.reference": layer(1, "torch"),
    "npa_envs.kernels": layer(1, "warp"),
    "npa_envs.world.cuda_graph": layer(3, "torch numpy", never=ORACLES),
    "npa_envs.ops": layer(2, "warp torch", never=("npa_envs.reference",)),
    "npa_envs.world.randomness": layer(3, "torch numpy", never=ORACLES),
    "npa_envs.rule.codes": layer(2, "torch"),
    "npa_envs.rule.network": layer(3, "torch"),
    "npa_envs.rule.rule": layer(4, "torch"),
    "npa_envs.rule": layer(5, "torch safetensors", never=INSIDES),
    "npa_envs.world": layer(6, "torch", never=ORACLES),
    "npa_envs.tasks": layer(7, "torch numpy PIL sklearn trimesh", never=ORACLES),
    "npa_envs.render": layer(8, "torch numpy PIL imageio imageio_ffmpeg pygame", never=ORACLES),
    "npa_envs.training": layer(9, "torch numpy tqdm yaml tensorboard", never=ORACLES),
    "npa_envs": Layer(10, frozenset({COMPUTED_NAME}), never=ORACLES),
    "npa_envs.measure.record": layer(3, "torch", never=INSIDES),
    "npa_envs.measure.plots": layer(2, "matplotlib"),
    "npa_envs.measure.judge": layer(10, "torch", never=INSIDES),
    "npa_envs.measure.quality": layer(11, "torch numpy tqdm", never=INSIDES),
    "npa_envs.measure.interaction": layer(11, "torch numpy matplotlib", never=ORACLES),
    "npa_envs.measure.speed": layer(13, "torch numpy matplotlib", never=("npa_envs.kernels",)),
    "npa_envs.measure.accuracy": layer(14, "torch matplotlib", never=("npa_envs.kernels",)),
    "npa_envs.measure.robustness": layer(15, "torch", never=ORACLES),
    "npa_envs.measure": layer(16),
    "npa_envs.envs": layer(17, "torch numpy gymnasium pettingzoo", never=INSIDES),
    "npa_envs.wrappers": layer(
        18,
        "torch numpy gymnasium pettingzoo stable_baselines3 ray torchrl tensordict rsl_rl minari "
        "h5py",
        never=INSIDES,
    ),
    "npa_envs.agents": layer(
        19, "torch numpy tqdm gymnasium pettingzoo stable_baselines3 cma", never=INSIDES
    ),
    "npa_envs.agents.comparison": layer(20, "torch numpy PIL matplotlib", never=INSIDES),
    "npa_envs.agents.search": layer(20, "torch numpy cma ribs", never=INSIDES),
    "npa_envs.web": layer(21, "torch numpy gymnasium PIL starlette uvicorn", never=ORACLES),
    "npa_envs.cli": Layer(
        22,
        frozenset({COMPUTED_NAME, "torch", "numpy", "tqdm", "tyro", "imageio_ffmpeg"}),
        never=ORACLES,
    ),
    "npa_envs.__main__": layer(23),
}


def source_files() -> list[Path]:
    folders = [ROOT / "npa_envs", *(ROOT / name for name in MAPPED)]
    return sorted(p for folder in folders for p in folder.rglob("*.py"))


def module_name(path: Path) -> str:
    parts = list(path.relative_to(ROOT).with_suffix("").parts)
    parts = parts[:-1] if parts[-1] == "__init__" else parts
    return ".".join(parts if parts[0] == "npa_envs" else ["npa_envs", *parts])


MODULES = {module_name(path) for path in source_files()}


def row_of(module: str) -> str | None:
    """The longest row that contains `module`; a submodule needs its own row."""
    name = module
    while name not in LAYERS and "." in name:
        name = name.rpartition(".")[0]
    if name not in LAYERS or (name == "npa_envs" and module != "npa_envs"):
        return None
    return name


def imported_modules(module: str, source: str, *, is_package: bool) -> set[str]:
    """Every module that `source` imports, also inside functions, with relative names resolved."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parts = module.split(".")
                kept = parts[: len(parts) - node.level + (1 if is_package else 0)]
                base = ".".join([*kept, *([node.module] if node.module else [])])
            for alias in node.names:
                inner = f"{base}.{alias.name}"
                found.add(inner if inner in MODULES or inner in LAYERS else base)
        elif isinstance(node, ast.Call):
            called = ast.unparse(node.func)
            if called in {"__import__", "import_module", "importlib.import_module"}:
                argument = node.args[0] if node.args else None
                is_text = isinstance(argument, ast.Constant) and isinstance(argument.value, str)
                found.add(str(argument.value) if is_text else COMPUTED_NAME)  # type: ignore[union-attr]
    return found


def violations(module: str, source: str, *, is_package: bool = False) -> list[str]:
    """What the `source` of a `module` imports against the layers."""
    row = row_of(module)
    if row is None:
        return [f"{module} has no row in the table of layers"]
    here = LAYERS[row]
    wrong = []
    for name in sorted(imported_modules(module, source, is_package=is_package)):
        top = name.split(".")[0]
        if top != "npa_envs":
            if top not in sys.stdlib_module_names and top not in here.libraries:
                wrong.append(f"{module} imports the library {name}")
            continue
        other = row_of(name)
        if other is None:
            wrong.append(f"{module} imports {name}, which has no row in the table of layers")
        elif other != row and LAYERS[other].level >= here.level:
            wrong.append(f"{module} imports {name}, which is in no lower layer")
        elif other.startswith(here.never):
            wrong.append(f"{module} imports {name}, which it must not know")
    return wrong


@pytest.mark.parametrize("path", source_files(), ids=lambda p: p.relative_to(ROOT).as_posix())
def test_every_source_file_keeps_to_the_layers(path: Path) -> None:
    is_package = path.name == "__init__.py"
    source = path.read_text(encoding="utf-8")
    assert violations(module_name(path), source, is_package=is_package) == []


WRONG = [
    ("npa_envs.kernels.portable.sort", "from npa_envs.ops import perceive"),
    ("npa_envs.rule.rule", "import warp"),
    ("npa_envs.world.rollout", "def f():\n    import warp"),
    ("npa_envs.ops.new", "from npa_envs.reference import splat"),
    ("npa_envs.world.rollout", "from ..tasks import targets"),
    ("npa_envs.training.new", "import importlib\nimportlib.import_module('warp')"),
    ("npa_envs.envs.new", "from npa_envs.ops.pictures.splat import splat"),
    ("npa_envs.envs.new", "from ..kernels import domain"),
    ("npa_envs.unheard_of", ""),
]
RIGHT = [
    ("npa_envs.kernels.portable.sort", "import math\nimport warp as wp\nfrom . import domain"),
    ("npa_envs.ops.launch", "import torch\nimport warp\nfrom npa_envs.kernels import domain"),
    ("npa_envs.agents.new", "import npa_envs\nfrom npa_envs.envs import new"),
]


@pytest.mark.parametrize(
    ("module", "source", "count"), [(*row, 1) for row in WRONG] + [(*row, 0) for row in RIGHT]
)
def test_the_checker_refuses_a_wrong_import_alone(module: str, source: str, count: int) -> None:
    assert len(violations(module, source)) == count
