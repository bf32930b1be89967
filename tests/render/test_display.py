"""What notebooks show of worlds, environments and rules."""

import base64
import io
import re

import gymnasium as gym
import numpy as np
import pytest
import torch
from crowds import small as small_crowd
from PIL import Image

import npa_envs
from npa_envs.envs import multispecies_v0
from npa_envs.render import draw_worlds, show_worlds, write_webp

SIZE = 24


def worlds(*, steps=(), count=2):
    generator = torch.Generator().manual_seed(3)
    x = torch.rand(*steps, count, 64, 2, generator=generator) - 0.5
    return x, torch.rand(*steps, count, 64, 8, generator=generator) - 0.5


def shown_picture(thing):
    """The picture that Jupyter shows of something."""
    bundle = thing._repr_mimebundle_()
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(bundle["image/jpeg"]))))


def test_worlds_are_shown_side_by_side():
    x, s = worlds()
    s[..., -3:] = torch.tensor([[0.5, -0.5, -0.5], [-0.5, -0.5, 0.5]])[:, None]
    drawing = {"resolution": SIZE, "pixel_size": 0.1, "half_width": 0.5}
    picture = shown_picture(show_worlds(x, s, **drawing))
    assert picture.shape == (SIZE, 2 * SIZE + 4, 3)
    expected = draw_worlds(x, s, **drawing)
    # JPEG is not exact.
    assert np.abs(picture[:, :SIZE].astype(float) - expected[0]).mean() < 12
    assert np.abs(picture[:, -SIZE:].astype(float) - expected[1]).mean() < 12
    assert np.abs(expected[0].astype(float) - expected[1]).mean() > 20


def test_a_trajectory_is_shown_as_a_film():
    x, s = worlds(steps=(5,), count=1)
    film = show_worlds(x, s, fps=10, resolution=SIZE)
    assert repr(film) == f"a film of 5 pictures of {SIZE} × {SIZE} pixels"
    html = film._repr_mimebundle_()["text/html"]
    (data,) = re.fullmatch(r'<img alt="[^"]+" src="data:image/webp;base64,([^"]+)">', html).groups()
    opened = Image.open(io.BytesIO(base64.b64decode(data)))
    assert (opened.n_frames, opened.size) == (5, (SIZE, SIZE))
    opened.load()
    assert opened.info["duration"] == 100


def test_particles_that_stand_apart_are_drawn_as_large_as_they_stand_apart():
    side = torch.linspace(-0.5, 0.5, 11)
    x = torch.cartesian_prod(side, side)[None]
    s = torch.zeros(1, 121, 8)
    given = show_worlds(x, s, resolution=SIZE, pixel_size=0.1).frames[0]
    found = show_worlds(x, s, resolution=SIZE).frames[0]
    assert np.abs(given.astype(float) - found).mean() < 10


def test_a_webp_repeats_and_keeps_its_rate(tmp_path):
    frames = [np.full((8, 12, 3), 40 * k, np.uint8) for k in range(4)]
    write_webp(tmp_path / "film.webp", frames, 20)
    with Image.open(tmp_path / "film.webp") as film:
        assert (film.n_frames, film.size, film.info["loop"]) == (4, (12, 8), 0)
        film.seek(3)
        assert abs(int(np.asarray(film.convert("RGB")).mean()) - 120) <= 2


@pytest.mark.parametrize("kind", ["single", "vector", "species"])
def test_environments_show_their_worlds(kind):
    if kind == "species":
        env = multispecies_v0.parallel_env(**small_crowd("mixing"))
    else:
        small = {"particle_count": 32, "render_size": SIZE}
        name = "npa/Morphogenesis2D-v0"
        made = gym.make_vec(name, 3, **small) if kind == "vector" else gym.make(name, **small)
        env = made.unwrapped
    assert list(env._repr_mimebundle_()) == ["text/plain"]
    env.reset(seed=0)
    picture = shown_picture(env)
    size = env.config.render_size
    side = 2 * size + 4 if kind == "vector" else size
    assert picture.shape == (side, side, 3)
    assert picture.std() > 5
    assert env._repr_mimebundle_()["text/plain"] == str(env)
    env.close()


def test_a_rule_shows_what_it_is():
    rule = npa_envs.NPARule(2, 8, 16, eps0=0.2)
    html = rule._repr_html_()
    assert f"{rule.perception_dim} numbers" in html
    assert f"16 hidden units, {rule.weight_count} weights" in html
    assert "ε0 = 0.2 " in html
    assert "read-out" not in html
    still = npa_envs.load_rule("digits")._repr_html_()
    assert "moves" not in still
    assert "<th>read-out</th><td>10 outputs</td>" in still
