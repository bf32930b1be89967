"""The layers: each module imports only modules of lower layers, and few libraries.

The table below is the whole rule. A new module needs a row (or lies in a folder that has one); the
libraries named are the only ones outside Python's own that its files may import, at any depth.
"""

import ast
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).resolve().parents[2]
MAPPED = ("envs", "wrappers", "agents")


class Layer(NamedTuple):
    """The height of a module and the libraries that it may use."""

    level: int
    libraries: str = ""
    never: tuple[str, ...] = ()
    """Modules of lower layers that it must not import."""


COMPUTED_NAME = "<computed>"
"""A module that is imported by a computed name."""
INSIDES = ("npa_envs.kernels", "npa_envs.ops", "npa_envs.reference")
"""Not for users of worlds and operators, who take `npa_envs.world` and the public names."""
ORACLES = ("npa_envs.kernels", "npa_envs.reference")
LAYERS = {
    "npa_envs.errors": Layer(0),
    "npa_envs.registration": Layer(0, "gymnasium"),
    "npa_envs.checks": Layer(1, "torch"),
    "npa_envs.atomic_files": Layer(1),
    "npa_envs.compile_lock": Layer(0),
    "npa_envs.runtime": Layer(1, "warp"),
    "npa_envs.reference": Layer(1, "torch"),
    "npa_envs.kernels": Layer(1, "warp"),
    "npa_envs.world.cuda_graph": Layer(3, "torch numpy", never=ORACLES),
    "npa_envs.ops": Layer(2, "warp torch", never=("npa_envs.reference",)),
    "npa_envs.world.randomness": Layer(3, "torch numpy", never=ORACLES),
    "npa_envs.rule.picture_codes": Layer(2, "torch"),
    "npa_envs.rule.folded_network": Layer(3, "torch"),
    "npa_envs.rule.rule": Layer(4, "torch"),
    "npa_envs.rule": Layer(5, "torch safetensors", never=INSIDES),
    "npa_envs.world": Layer(6, "torch", never=ORACLES),
    "npa_envs.tasks": Layer(7, "torch numpy PIL sklearn trimesh scipy pillow_heif", never=ORACLES),
    "npa_envs.render": Layer(
        8, "torch numpy PIL imageio imageio_ffmpeg pygame sklearn umap", never=ORACLES
    ),
    "npa_envs.training": Layer(9, "torch numpy tqdm yaml tensorboard", never=ORACLES),
    "npa_envs": Layer(10, COMPUTED_NAME, never=ORACLES),
    "npa_envs.measure.benchmark_records": Layer(3, "torch", never=INSIDES),
    "npa_envs.measure.plots": Layer(2, "matplotlib"),
    "npa_envs.measure.process_queue": Layer(1),
    "npa_envs.measure.texture_metric": Layer(10, "torch", never=INSIDES),
    "npa_envs.measure.wounds": Layer(10, "torch", never=INSIDES),
    "npa_envs.measure.quality": Layer(11, "torch numpy tqdm", never=INSIDES),
    "npa_envs.measure.rule_interaction": Layer(12, "torch numpy matplotlib", never=ORACLES),
    "npa_envs.measure.speed": Layer(13, "torch numpy matplotlib", never=("npa_envs.kernels",)),
    "npa_envs.measure.accuracy": Layer(14, "torch matplotlib", never=("npa_envs.kernels",)),
    "npa_envs.measure.robustness": Layer(15, "torch", never=ORACLES),
    "npa_envs.measure": Layer(16),
    "npa_envs.envs": Layer(17, "torch numpy gymnasium pettingzoo", never=INSIDES),
    "npa_envs.wrappers": Layer(
        18,
        "torch numpy gymnasium pettingzoo stable_baselines3 ray torchrl tensordict rsl_rl minari "
        "h5py",
        never=INSIDES,
    ),
    "npa_envs.agents": Layer(
        19, "torch numpy tqdm gymnasium pettingzoo stable_baselines3 cma", never=INSIDES
    ),
    "npa_envs.agents.comparison": Layer(20, "torch numpy PIL matplotlib", never=INSIDES),
    "npa_envs.agents.search": Layer(20, "torch numpy cma ribs", never=INSIDES),
    "npa_envs.web": Layer(21, "torch numpy gymnasium PIL starlette uvicorn", never=ORACLES),
    "npa_envs.cli": Layer(
        22, f"{COMPUTED_NAME} torch numpy tqdm tyro imageio_ffmpeg", never=ORACLES
    ),
    "npa_envs.__main__": Layer(23),
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


def imported_modules(source: str) -> Iterator[str]:
    """Yield every module that `source` imports, also inside functions."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            # A relative name has no row in the table.
            base = "." * node.level + (node.module or "")
            for alias in node.names:
                inner = f"{base}.{alias.name}"
                yield inner if inner in MODULES or inner in LAYERS else base
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith("import_module"):
            name = node.args[0]
            yield str(name.value) if isinstance(name, ast.Constant) else COMPUTED_NAME


def violations(module: str, source: str) -> list[str]:
    """What the `source` of a `module` imports against the layers."""
    row = row_of(module)
    if row is None:
        return [f"{module} has no row in the table of layers"]
    rule, wrong = LAYERS[row], []
    libraries = {*sys.stdlib_module_names, *rule.libraries.split()}
    for name in sorted(set(imported_modules(source))):
        top = name.split(".")[0]
        if top != "npa_envs":
            if top not in libraries:
                wrong.append(f"{module} imports the library {name}")
            continue
        other = row_of(name)
        if other is None:
            wrong.append(f"{module} imports {name}, which has no row in the table of layers")
        elif other != row and LAYERS[other].level >= rule.level:
            wrong.append(f"{module} imports {name}, which is in no lower layer")
        elif other.startswith(rule.never):
            wrong.append(f"{module} imports {name}, which it must not know")
    return wrong


def test_every_source_file_keeps_to_the_layers() -> None:
    modules = {module_name(path): path.read_text(encoding="utf-8") for path in source_files()}
    assert [text for module in modules.items() for text in violations(*module)] == []


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("npa_envs.kernels.portable.sort", "from npa_envs.ops import perceive"),
        ("npa_envs.world.rollout", "def f():\n    import warp"),
        ("npa_envs.world.rollout", "from ..tasks import targets"),
        ("npa_envs.training.new", "import importlib\nimportlib.import_module('warp')"),
        ("npa_envs.envs.new", "from npa_envs.ops.pictures.splat import splat"),
        ("npa_envs.unheard_of", ""),
    ],
)
def test_a_wrong_import_is_noticed(module: str, source: str) -> None:
    assert len(violations(module, source)) == 1
