"""The programs of docs/integrations.md: each runs as it stands there, and learns."""

import re
from pathlib import Path

import imageio.v3 as imageio
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

TEXT = (Path(__file__).resolve().parents[2] / "docs/integrations.md").read_text("utf-8")
RANDOM, RANDOM_ERROR = 0.143, 0.018
"""Return of random actions in the worlds of the tutorial, by its table."""

pytestmark = [
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
    pytest.mark.filterwarnings("ignore::FutureWarning"),
    pytest.mark.filterwarnings("ignore::UserWarning"),
]


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def program(mark: str) -> str:
    """Return the page's one program that holds a piece of text."""
    blocks = re.findall(r"^```python\n(.*?)^```", TEXT, re.MULTILINE | re.DOTALL)
    (block,) = (block for block in blocks if mark in block)
    return block


def run(code: str, *, rounds: int = 60) -> None:
    """Run a program, with another number of rounds than the page's."""
    code = re.sub(r"^rounds(.*) = 60", rf"rounds\1 = {rounds}", code, flags=re.M)
    exec(compile(code, "integrations.md", "exec"), {})


def test_callbacks_logs_and_films_of_stable_baselines3(tmp_path):
    sb3 = pytest.importorskip("stable_baselines3")
    pytest.importorskip("moviepy")
    run(program("CheckpointCallback"))
    runs = tmp_path / "runs"
    assert sb3.PPO.load(runs / "rl_model_16384_steps.zip").num_timesteps == 16384
    assert sb3.PPO.load(runs / "best_model.zip").num_timesteps in (8192, 16384)
    log = EventAccumulator(str(runs / "PPO_1")).Reload()
    assert [event.value for event in log.Scalars("eval/mean_ep_length")] == [16.0, 16.0]
    rewards = log.Scalars("rollout/ep_rew_mean")
    assert [event.step for event in rewards] == [4096, 8192, 12288, 16384]
    (film,) = runs.glob("*.mp4")
    assert len(imageio.imread(film)) in (17, 18)


def test_films_of_gymnasium(tmp_path):
    pytest.importorskip("moviepy")
    run(program("RecordVideos"))
    for name, side in (("one", 256), ("four", 512)):
        film = imageio.imread(next((tmp_path / "films" / name).glob("*.mp4")))
        # The first picture and 24 steps; moviepy 1.0.3 may show the last one twice.
        assert len(film) in (25, 26)
        assert film.shape[1:] == (side, side, 3)
        assert abs(film[-1].astype(float) - film[0]).mean() > 1.0


def test_weights_and_biases_follows_the_logs(tmp_path, monkeypatch):
    pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    run(program("sync_tensorboard"))
    (record,) = (tmp_path / "wandb").glob("offline-run-*/*.wandb")
    assert b"rollout/ep_rew_mean" in record.read_bytes()


@pytest.mark.parametrize(
    ("library", "module", "mark"),
    [("TorchRL", "torchrl", "NPATorchRLEnv("), ("RSL-RL", "rsl_rl", "RslRlParticleEnv(")],
)
@pytest.mark.parametrize("rounds", [1, pytest.param(60, marks=pytest.mark.slow)])
def test_particles_learn_to_act_for_their_world(library, module, mark, rounds, capsys):
    pytest.importorskip(module)
    run(program(mark), rounds=rounds)
    printed = capsys.readouterr().out
    ((mean, error),) = re.findall(rf"^{library}: (-?[\d.]+) ± ([\d.]+)$", printed, re.M)
    assert float(error) < 0.05
    if rounds == 60:
        assert float(mean) > RANDOM + 10.0 * (RANDOM_ERROR + float(error))
        (on_page,) = re.findall(rf"^{library}: ([\d.]+) ± [\d.]+$", TEXT, re.M)
        assert float(mean) == pytest.approx(float(on_page), abs=0.3)


@pytest.mark.slow
def test_rllib_learns(capsys):
    ray = pytest.importorskip("ray")
    ray.init(num_cpus=1, include_dashboard=False, log_to_driver=False, logging_level="ERROR")
    try:
        run(program("rllib_rows_config"), rounds=30)
    finally:
        ray.shutdown()
    (mean,) = re.findall(r"^RLlib: (-?[\d.]+)$", capsys.readouterr().out, re.M)
    assert float(mean) > 3.0 * RANDOM
