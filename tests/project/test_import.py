"""Importing the package is cheap: it starts no device and pulls in no heavy extra."""

import os
import sys

import numpy as np
import pytest
from support.learning_problems import heart
from support.processes import run_alone

from npa_envs import wrappers
from npa_envs.agents.learning import Budget, train
from npa_envs.errors import MissingDependencyError
from npa_envs.render import Window, write_mp4
from npa_envs.runtime import without_line
from npa_envs.tasks.targets.digit_clouds import load_pictures
from npa_envs.tasks.targets.meshes import load_mesh

PACKAGE = """
import atexit, os, sys, torch
atexit.register(lambda: print("left:", os.path.exists(warps_folder)))

def settings():
    b = torch.backends
    return (torch.get_default_dtype(), torch.get_num_threads(), torch.initial_seed(),
            torch.is_grad_enabled(), b.cuda.matmul.allow_tf32, b.cudnn.benchmark)

torch.manual_seed(5)
before, state = settings(), torch.get_rng_state()
import npa_envs
print("names:", sorted(dir(npa_envs)) == sorted([*npa_envs.__all__, "__version__"]))
import npa_envs.envs, npa_envs.envs.multi, npa_envs.render
print("settings:", settings() == before, torch.equal(state, torch.get_rng_state()))
unwanted = ("stable_baselines3", "matplotlib", "imageio", "imageio_ffmpeg", "tensorboard", "tyro",
            "yaml", "pettingzoo", "pygame", "torch._dynamo")
print("extras:", [name for name in unwanted if name in sys.modules])
warp = sys.modules.get("warp")
runtime = None if warp is None else sys.modules["warp._src.context"].runtime
print("devices:", torch.cuda.is_initialized(), runtime)
x, s = torch.rand(1, 9, 2), torch.rand(1, 9, 3, requires_grad=True)
for _ in range(4):
    npa_envs.perceive(x, s, 0.5).sum().backward()
print("torch's compiler:", "torch._dynamo" in sys.modules)
warps_folder = sys.modules["warp._src.context"].runtime.get_clang_pch_dir()
import importlib.util, warnings
warnings.simplefilter("error")
# Gymnasium, where it was imported, hides pygame's banner as well.
os.environ.pop("PYGAME_HIDE_SUPPORT_PROMPT", None)
import gymnasium
gymnasium.make("npa_envs:npa/Morphogenesis2D-v0", particle_count=8)
gymnasium.make_vec("npa/Morphogenesis2D-v0", 2, "vector_entry_point")
if importlib.util.find_spec("pygame"):
    npa_envs.render.Window("a world", 32).close()
"""

HELP = """
import contextlib, io, os, sys
from npa_envs.cli import main
with contextlib.redirect_stdout(io.StringIO()):
    main(["--help"]), main(["--version"])
print("heavy:", [m for m in ("torch", "warp", "tyro") if m in sys.modules])
print("threads:", os.environ["OMP_WAIT_POLICY"])
"""

WITHOUT_EXTRAS = """
import npa_envs.wrappers as wrappers
assert {*wrappers.__all__, "ParticleVecEnv"} <= set(dir(wrappers))
wrappers.DamageEvents, wrappers.TorchNormalizeReward
print("stable_baselines3" in sys.modules)
for name in ("stable_baselines3", "pettingzoo", "ray", "torchrl", "rsl_rl"):
    sys.modules[name] = None
from npa_envs.wrappers import *
print("ParticleVecEnv" in globals(), DamageEvents.__name__, VectorSpeciesTags.__name__)
from npa_envs.errors import MissingDependencyError
print(issubclass(MissingDependencyError, ImportError))
try:
    wrappers.ParticleVecEnv
except MissingDependencyError as error:
    print(str(error).split(": ")[-1])
try:
    import npa_envs.envs.multispecies_v0
except MissingDependencyError as error:
    print(str(error).split(": ")[-1])
"""


@pytest.mark.parametrize(
    ("program", "printed", "policy"),
    [
        (
            PACKAGE,
            "names: True\nsettings: True True\nextras: []\ndevices: False None\n"
            "torch's compiler: False\nleft: False\n",
            None,
        ),
        (
            HELP + WITHOUT_EXTRAS,
            "heavy: []\nthreads: passive\nFalse\nFalse DamageEvents VectorSpeciesTags\nTrue\n"
            "pip install 'npa-envs[sb3]'\npip install 'npa-envs[envs]'\n",
            None,
        ),
        # Threads of OpenMP wait without a busy loop, unless somebody has said otherwise.
        (HELP, "heavy: []\nthreads: active\n", "active"),
    ],
    ids=["the package", "help, without extras", "help, with a policy of threads"],
)
def test_a_fresh_process_imports_no_more_than_is_asked_for(program, printed, policy, monkeypatch):
    monkeypatch.delenv("OMP_WAIT_POLICY", raising=False)
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    if policy is not None:
        monkeypatch.setenv("OMP_WAIT_POLICY", policy)
    done = run_alone(program)
    assert (done.stdout, done.stderr) == (printed, "")


def test_lines_are_left_out_of_what_native_code_writes(capfd):
    with without_line(b"one"):
        os.write(2, b"one\ntwo\n")
    assert capfd.readouterr().err == "two\n"


FRAME, ONE_STEP = np.zeros((4, 4, 3), np.uint8), Budget(particle_steps=1)
EXTRA = r"pip install 'npa-envs\[{}\]'"


def wrapper(module, name):
    """Import a wrapper as a first user does."""
    sys.modules.pop(f"npa_envs.wrappers.{module}", None)
    vars(wrappers).pop(module, None)
    return getattr(wrappers, name)


@pytest.mark.parametrize(
    ("library", "hint", "call"),
    [
        ("cma", EXTRA.format("evolution"), lambda _: train("evolution", heart(), ONE_STEP, 0)),
        ("sklearn", EXTRA.format("points"), lambda _: load_pictures("digits")),
        ("trimesh", EXTRA.format("meshes"), load_mesh),
        ("torchrl.data", EXTRA.format("torchrl"), lambda _: wrapper("torchrl", "NPATorchRLEnv")),
        ("rsl_rl.env", EXTRA.format("rslrl"), lambda _: wrapper("rsl_rl", "RslRlParticleEnv")),
        ("pygame", EXTRA.format("human"), lambda _: Window("a world", 32)),
        ("imageio_ffmpeg", r"pip install 'imageio\[ffmpeg\]'", lambda p: write_mp4(p, [FRAME])),
    ],
)
def test_a_missing_library_is_named_with_its_hint(library, hint, call, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, library, None)
    film, mesh = tmp_path / "film.mp4", tmp_path / "mesh.stl"
    mesh.write_text("solid", encoding="utf-8")
    with pytest.raises(MissingDependencyError, match=hint):
        call(film if library == "imageio_ffmpeg" else mesh)
    assert not film.exists()
