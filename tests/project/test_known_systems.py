"""Programs of `examples/` that write films of known systems: what is true of each."""

import math
import runpy
import sys
from pathlib import Path

import imageio.v3 as imageio
import pytest
import torch

import npa_envs
from npa_envs.reference import differences

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


def program(name):
    names = runpy.run_path(str(EXAMPLES / f"{name}.py"))
    return names, torch.Generator().manual_seed(0)


def test_birds_that_see_each_other_fly_one_way_by_alignment_alone():
    boids, generator = program("boids")
    x, v = boids["start"](50, generator)
    assert boids["polarisation"](v) < 0.3
    others = {"cohesion": 0.0, "separation": 0.0}
    for options, low, high in (({}, 0.8, 1.0), (others, 0.8, 1.0), ({"alignment": 0.0}, 0.0, 0.3)):
        place, velocity = 0.04 * x, v
        for _ in range(40):
            place, velocity = boids["step"](place, velocity, **{"alignment": 1.0} | options)
        assert low < boids["polarisation"](velocity) < high + 1e-6


@pytest.mark.parametrize(("distance", "comes_nearer"), [(0.03, False), (0.1, True)])
def test_two_birds_come_together_but_not_too_near(distance, comes_nearer):
    boids, _ = program("boids")
    x = torch.tensor([[[0.0, 0.0], [distance, 0.0]]])
    x, _ = boids["step"](x, torch.tensor([[[0.0, 0.006], [0.0, 0.006]]]))
    assert (x[0, 1, 0] - x[0, 0, 0] < distance) == comes_nearer


def test_a_wave_on_stirred_particles_decays_as_diffusion_does_and_loses_nothing():
    gray_scott, generator = program("gray_scott")
    x, s, eps = gray_scott["start"](1024, generator)
    for _ in range(5):
        x, s = gray_scott["step"](x, s, eps)
    volume = 1.0 / npa_envs.perception_fields(x, s, eps, box=2.0).rho[..., None]
    wave = torch.sin(math.pi * x[..., :1])
    u, time = wave, 0.02 * eps**2
    for _ in range(100):
        u = u + time * gray_scott["laplacian"](x, u, eps)
    amplitude = float((volume * u * wave).sum() / (volume * wave * wave).sum())
    assert -math.log(amplitude) / (100 * time * math.pi**2) == pytest.approx(1.0, abs=0.01)
    assert float((volume * (u - wave)).sum()) == pytest.approx(0.0, abs=1e-5)
    assert u.abs().max() <= 1.0


def test_spots_of_gray_and_scott_divide_and_their_mass_keeps_its_bounds():
    gray_scott, generator = program("gray_scott")
    x, s, eps = gray_scott["start"](1024, generator)
    contrasts = []
    for k in range(61):
        contrasts.append(float(s[..., 1].std()))
        assert s.min() >= 0.0
        assert s[..., 0].max() <= 1.0 + 1e-6
        assert s.sum(dim=-1).mean() <= 1.0
        if k < 60:
            x, s = gray_scott["step"](x, s, eps)
    assert contrasts[60] > 1.8 * contrasts[0]
    assert contrasts[60] > 1.1 * contrasts[20]


def test_particle_life_has_the_published_force_up_to_the_rounding_of_float32():
    life, generator = program("particle_life")
    x, table = life["start"](50, generator)
    r = differences(x, (1.0, 1.0))
    distance = r.norm(dim=-1) / life["RADIUS"]
    drawn = table.repeat_interleave(50, dim=0).repeat_interleave(50, dim=1)
    tent = drawn * (1.0 - (2.0 * distance - 1.3).abs() / 0.7)
    size = torch.where(distance < 0.3, distance / 0.3 - 1.0, tent).where(distance < 1.0, 0.0)
    unit = r / (distance * life["RADIUS"]).clamp(min=1e-12)[..., None]
    published = (size[..., None] * unit).sum(dim=2)
    assert published.norm(dim=-1).max() > 1.0
    assert (life["force"](x, table) - published).abs().max() < 1e-5
    assert life["force"](x, table).sum(dim=1).norm() > 1.0, "kinds flee what is drawn to them"
    assert life["force"](x, table + table.T).sum(dim=1).norm() < 1e-5, "action is reaction"


@pytest.mark.parametrize("words", ["boids", "gray_scott --particles 1024", "particle_life"])
def test_a_known_system_writes_its_film(words, tmp_path, monkeypatch):
    film = tmp_path / "film.webp"
    monkeypatch.setattr(sys, "argv", [*words.split(), "--steps", "8", "--film", str(film)])
    threads = torch.get_num_threads()
    path = EXAMPLES / f"{sys.argv[0]}.py"
    assert len(path.read_text(encoding="utf-8").splitlines()) <= 120
    runpy.run_path(str(path), run_name="__main__")
    torch.set_num_threads(threads)
    frames = imageio.imread(film, index=...)
    assert len(frames) > 1
    assert frames[0].std() > 10.0
    assert (frames[0] != frames[-1]).any()
