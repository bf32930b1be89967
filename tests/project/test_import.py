"""Importing the package is cheap: it starts no device and pulls in no heavy extra."""

import subprocess
import sys
from pathlib import Path

UNWANTED = ("stable_baselines3", "matplotlib", "imageio", "tensorboard", "tyro", "yaml")


def run(program: str) -> str:
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return done.stdout


def test_import_prints_nothing_starts_no_device_and_leaves_heavy_libraries_alone() -> None:
    program = (
        "import sys, npa_envs\n"
        f"print([m for m in {UNWANTED!r} if m in sys.modules])\n"
        "import torch\n"
        "warp = sys.modules.get('warp')\n"
        "runtime = None if warp is None else sys.modules['warp._src.context'].runtime\n"
        "print(torch.cuda.is_initialized(), runtime)"
    )
    assert run(program) == "[]\nFalse None\n"


def test_import_leaves_the_global_settings_of_torch_alone() -> None:
    program = (
        "import torch\n"
        "def settings():\n"
        "    b = torch.backends\n"
        "    return (torch.get_default_dtype(), torch.get_num_threads(), torch.initial_seed(),\n"
        "            torch.is_grad_enabled(), b.cuda.matmul.allow_tf32, b.cudnn.benchmark)\n"
        "torch.manual_seed(5)\n"
        "before, state = settings(), torch.get_rng_state()\n"
        "import npa_envs\n"
        "print(settings() == before, torch.equal(state, torch.get_rng_state()))"
    )
    assert run(program) == "True True\n"


def test_old_names_are_the_new_modules_and_nothing_within_them_runs_a_second_time() -> None:
    program = (
        "import warnings; warnings.simplefilter('ignore')\n"
        "import npa_envs.sph, npa_envs.tasks.task, npa_envs.ops, npa_envs.tasks.base\n"
        "print(npa_envs.sph is npa_envs.ops, npa_envs.tasks.task is npa_envs.tasks.base)\n"
        "try: import npa_envs.sph.perceive\n"
        "except ModuleNotFoundError as error: print(error)\n"
    )
    refused = "no module npa_envs.sph.perceive: npa_envs.sph is now npa_envs.ops"
    assert run(program) == f"True True\n{refused}\n"


def test_the_package_shows_its_public_names_alone() -> None:
    program = (
        "import npa_envs\n"
        "print(sorted(dir(npa_envs)) == sorted([*npa_envs.__all__, '__version__']))"
    )
    assert run(program) == "True\n"


def test_folders_that_kernels_are_compiled_in_are_removed_without_a_warning() -> None:
    program = (
        "import sys, warnings\nfrom npa_envs.runtime import start_warp\nstart_warp()\n"
        "warnings.simplefilter('error')\n"
        "runtime = sys.modules['warp._src.context'].runtime\n"
        "folder = runtime.get_clang_pch_dir()\n"
        "print(folder)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert "ResourceWarning" not in done.stderr
    assert not Path(done.stdout.splitlines()[-1]).exists()
