"""3D morphogenesis: worlds, how particles look, the loss, training, commands, exported clouds."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from support.training_runs import lively_rule, worlds_of

from npa_envs.errors import NPAError
from npa_envs.measure.quality import measure
from npa_envs.render import turntable_frames, write_gaussians, write_points, write_splat
from npa_envs.rule.rule import NPARule
from npa_envs.tasks.gaussian_outputs import HARMONIC_0, OUTPUTS, appearance
from npa_envs.tasks.morphogenesis3d import Morphogenesis3D, Morphogenesis3DConfig
from npa_envs.tasks.targets import views
from npa_envs.tasks.targets.meshes import load_mesh
from npa_envs.tasks.targets.views import ANGLE, DISTANCE, composited, load_views, some_views
from npa_envs.world.particles import Particles

WORLD = {"target": "doughnut", "particle_count": 150, "eps": 0.3, "sigma": 0.1, "opacity": 0.5}
RULE = {"hidden_dim": 16, "readout_hidden_dim": 8}
VIEWS = {"training_views": 6, "held_out_views": 3, "views_per_iteration": 2, "resolution": 24}
LOSS = {"blur_sigma": 2.0, "blur_iterations": 10, "ssim_weight": 0.0}
SMALL = Morphogenesis3DConfig(**WORLD, **RULE, **VIEWS, **LOSS)


@pytest.fixture(scope="module")
def target():
    return load_views("doughnut", resolution=24, training_count=6, held_out_count=3)


@pytest.fixture
def task(target):
    return Morphogenesis3D(SMALL, target=target)


def worlds(task, world_count):
    x, s = worlds_of(task, world_count)
    return 0.6 * x, s


def test_outputs_of_zero_are_round_grey_particles():
    look = appearance(torch.zeros(1, 2, 20), sigma=0.05, anisotropy=0.1, opacity=0.15)
    assert torch.equal(look.quaternions, torch.tensor([1.0, 0, 0, 0]).expand(1, 2, 4))
    torch.testing.assert_close(look.scales, torch.full((1, 2, 3), 0.05))
    torch.testing.assert_close(look.opacities, torch.full((1, 2), 0.15))
    assert torch.equal(look.colours, torch.zeros(1, 2, 4, 3))


def test_outputs_stretch_within_the_bound_and_colour_as_the_rule_says(task):
    rule = lively_rule(task)
    assert (rule.space_dim, rule.readout_dim, rule.alpha) == (3, OUTPUTS, 1.0)
    x, s = worlds_of(task, 1)
    assert 0.95 < float(x.norm(dim=-1).max()) <= 1.0
    look = task.for_rule(rule).gaussians(20.0 * s)
    assert 0.09 < float(look.stretch.detach().abs().max()) <= 0.1 + 1e-7
    torch.testing.assert_close(look.scales, 0.1 * look.stretch.exp())
    torch.testing.assert_close(HARMONIC_0 * look.colours[..., 0, :] + 0.5, rule.colour(20.0 * s))
    opacities = look.opacities.detach()
    assert 0.0 < float(opacities.min()) < 0.4 < 0.6 < float(opacities.max()) < 1.0
    assert float(look.colours[..., 1:, :].detach().abs().max()) > 0.5
    worlds = Particles(torch.zeros(1, 150, 3), 20.0 * s).with_zero_paths()
    _, parts = task.for_rule(rule).loss(worlds)
    assert float(parts["isotropy"]) == pytest.approx(float(look.stretch.detach().abs().mean()))


def test_states_are_colours_where_there_is_no_read_out(task):
    x, s = worlds(task, 1)
    silent = task.for_rule(NPARule(3, 16, 8))
    assert torch.equal(task.picture(x, s), silent.picture(x, s))
    # As many channels as a read-out has outputs are no read-out.
    wide = torch.cat((torch.ones(1, 150, 4), s), dim=-1)
    broad = task.for_rule(NPARule(3, 20, 8))
    assert torch.equal(broad.picture(x, wide), task.picture(x, s))
    look = task.gaussians(s)
    torch.testing.assert_close(HARMONIC_0 * look.colours[..., 0, :], s[..., -3:])
    assert not torch.equal(task.for_rule(lively_rule(task)).picture(x, s), task.picture(x, s))


def under_the_surface(count, depth):
    """Return points below the doughnut's surface, and its colours there as lit: [1, N, 3] each."""
    mesh, random = load_mesh("doughnut"), np.random.default_rng(0)
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    outward = np.cross(b - a, c - a)
    area = np.linalg.norm(outward, axis=1, keepdims=True)
    chosen = random.choice(len(area), count, p=area[:, 0] / area.sum())
    u, v = random.random((2, count, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    x = a[chosen] + u * (b - a)[chosen] + v * (c - a)[chosen]
    x -= depth * (outward / area)[chosen]
    light = (mesh.normals() @ (np.array(views.LIGHT) / np.linalg.norm(views.LIGHT))).clip(0)
    shade = views.AMBIENT + (1 - views.AMBIENT) * light[mesh.faces[:, 0]]
    lit = mesh.colours[:, 0] * shade[:, None]
    colours = lit[chosen]
    return [torch.tensor(t, dtype=torch.float32)[None] for t in (x, colours)]


def test_particles_under_the_target_s_surface_look_like_it():
    """A world made by hand: held-out views by our Gaussians against those of the mesh."""
    fields = {"particle_count": 6000, "resolution": 48, "sigma": 0.02, "opacity": 0.7}
    task = Morphogenesis3D(dataclasses.replace(SMALL, training_views=1, **fields))
    # A pixel is 0.05 wide, and Gaussians reach beyond their middle.
    x, colours = under_the_surface(6000, depth=0.07)
    s = torch.zeros(1, 6000, 16)
    s[..., -3:] = colours - 0.5
    shuffled = s[:, torch.randperm(6000, generator=torch.Generator().manual_seed(0))]
    upside_down = x * torch.tensor([1.0, -1.0, 1.0])
    candidates = ((x, s), (x, shuffled), (upside_down, s))
    ratios = [float(task.view_psnr(*world)) for world in candidates]
    losses = [float(task.metric(*world)) for world in candidates]
    # Seen: 30.2, 21.8 and 17.6 dB, and losses of 0.006, 0.027 and 0.044.
    assert ratios[0] > 28.0
    assert max(ratios[1:]) < ratios[0] - 6.0
    assert losses[0] < 0.4 * min(losses[1:])


def test_psnr_is_that_of_colours_over_white(task):
    x, s = worlds(task, 2)
    held_out = task.target.held_out
    drawn = task.views(x, s, held_out.cameras)
    by_hand = []
    for world in range(2):
        ratios = []
        for view in range(3):
            pictures = (drawn[world, view], held_out.pictures[view])
            shown = [(p[..., :3] + 1 - p[..., 3:]).clamp(0, 1).double() for p in pictures]
            ratios.append(-10 * math.log10(float((shown[0] - shown[1]).square().mean())))
        by_hand.append(sum(ratios) / 3)
    assert task.view_psnr(x, s).tolist() == pytest.approx(by_hand, rel=1e-5)
    row = measure(task, x, s, 0)
    assert row.psnr == pytest.approx(sum(by_hand) / 2, rel=1e-5)
    assert row.psnr_worst == pytest.approx(min(by_hand), rel=1e-5)


def test_pictures_show_a_held_out_view_with_rows_up(task):
    x, s = worlds(task, 2)
    picture = task.picture(x, s)
    assert picture.shape == (2, 24, 24, 4)
    pictures = task.target.held_out.pictures
    assert any(torch.equal(task.target_picture.flip(0), p) for p in pictures)
    high = torch.zeros(1, 1, 3)
    high[..., 1] = 0.6
    rows = task.picture(high, torch.zeros(1, 1, 16))[0, ..., 3].sum(1)
    assert float((rows * torch.arange(24)).sum() / rows.sum()) > 14.0


def test_loss_sees_the_views_of_its_iteration_before_their_backgrounds(task):
    x, s = worlds(task, 2)
    far = torch.zeros(2, 150)
    first, _ = task.loss(Particles(x, s, far))
    task.begin(37)
    later, parts = task.loss(Particles(x, s, far))
    assert float(first) != float(later)
    # No blur is left: by hand, over the training views that the schedule says.
    assert float(task.blur_sigma) == 0.0
    chosen = some_views(task.target.training, task.view_index)
    drawn = task.views(x, s, chosen.cameras)
    error = 0.0
    for view in range(2):
        back = task.backgrounds[view]
        colours = composited(drawn[:, view], back) - composited(chosen.pictures[view], back)
        alpha = drawn[:, view, ..., 3:] - chosen.pictures[view, ..., 3:]
        error += float(torch.cat((colours, alpha), dim=-1).abs().mean()) / 2
    assert float(parts["views"]) == pytest.approx(error, rel=1e-5)
    task.begin(0)
    assert float(task.loss(Particles(x, s, far))[0]) == float(first)


def read_ply(path):
    """Return the columns of a binary PLY file, read by its header."""
    header, _, body = path.read_bytes().partition(b"end_header\n")
    lines = header.decode().split("\n")
    kinds = {"float": "<f4", "uchar": "u1"}
    fields = [line.split()[1:] for line in lines if line.startswith("property")]
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    return np.frombuffer(body, np.dtype([(name, kinds[kind]) for kind, name in fields]))


@pytest.fixture
def cloud(task):
    rule = lively_rule(task)
    x, s = worlds(task, 1)
    return x, task.for_rule(rule).gaussians(s), rule.colour(s)[0].clamp(0, 1).detach().numpy()


def test_points_are_written_with_their_colours(cloud, tmp_path):
    x, look, colours = cloud
    write_points(tmp_path / "a.ply", x, look)
    rows = read_ply(tmp_path / "a.ply")
    assert np.array_equal(np.stack([rows[n] for n in "xyz"], axis=1), x[0].numpy())
    written = np.stack([rows[n] for n in ("red", "green", "blue")], axis=1)
    assert np.abs(written / 255.0 - colours).max() < 0.51 / 255.0
    trimesh = pytest.importorskip("trimesh")
    assert np.allclose(trimesh.load(tmp_path / "a.ply").vertices, x[0].numpy())


def test_gaussians_are_written_as_others_read_them(cloud, tmp_path):
    x, look, colours = cloud
    write_gaussians(tmp_path / "a.ply", x, look)
    rows = read_ply(tmp_path / "a.ply")
    scales = np.exp([rows[f"scale_{k}"] for k in range(3)]).T
    assert np.allclose(scales, look.scales[0].detach(), rtol=1e-5)
    assert np.allclose(1 / (1 + np.exp(-rows["opacity"])), look.opacities[0].detach(), atol=1e-6)
    flat = np.stack([rows[f"f_dc_{k}"] for k in range(3)], axis=1)
    assert np.allclose((0.28209479 * flat + 0.5).clip(0, 1), colours, atol=1e-5)
    # Red's three coefficients of degree 1 come first.
    first = np.stack([rows[f"f_rest_{k}"] for k in range(3)], axis=1)
    assert np.allclose(first, look.colours[0, :, 1:, 0].detach())
    turns = np.stack([rows[f"rot_{k}"] for k in range(4)], axis=1)
    expected = torch.nn.functional.normalize(look.quaternions[0], dim=-1).detach()
    assert np.allclose(turns, expected, atol=1e-6)
    assert (rows["nx"] == 0.0).all()


def test_splats_are_32_bytes_each_the_largest_first(cloud, task, tmp_path):
    x, look, colours = cloud
    write_splat(tmp_path / "a.splat", x, look)
    content = (tmp_path / "a.splat").read_bytes()
    assert len(content) == 32 * 150
    floats = np.frombuffer(content, "<f4").reshape(150, 8)
    bytes_ = np.frombuffer(content, np.uint8).reshape(150, 32)
    size = floats[:, 3:6].prod(axis=1) * bytes_[:, 27]
    assert (np.diff(size) <= 0.01 * size[0]).all()
    positions = x[0].numpy()
    order = [int(np.abs(positions - row[:3]).sum(axis=1).argmin()) for row in floats]
    assert sorted(order) == list(range(150))
    assert np.array_equal(floats[:, 3:6], look.scales[0, order].detach().numpy())
    assert np.abs(bytes_[:, 24:27] / 255.0 - colours[order]).max() < 0.51 / 255.0
    turns = torch.nn.functional.normalize(look.quaternions[0, order], dim=-1).detach().numpy()
    assert np.abs((bytes_[:, 28:] - 128.0) / 128.0 - turns).max() < 1.01 / 128.0
    # Round particles have no rotation.
    write_splat(tmp_path / "b.splat", x, task.gaussians(torch.zeros(1, 150, 16)))
    plain = np.frombuffer((tmp_path / "b.splat").read_bytes(), np.uint8).reshape(150, 32)
    assert (plain[:, 28:] == (255, 128, 128, 128)).all()
    with pytest.raises(NPAError, match="positions of one 3D world"):
        write_splat(tmp_path / "c.splat", x[0], look)


def test_turntables_go_once_around(task):
    """A particle to the right of the middle is behind it a quarter of a turn on."""
    x = torch.tensor([[[0.6, 0.0, 0.0]]])
    s = torch.full((1, 1, 16), -0.5)
    frames = turntable_frames(
        lambda cameras: task.views(x, s, cameras), frame_count=4, resolution=32, elevation=0.0
    )
    pixel = DISTANCE * math.tan(math.radians(0.5 * ANGLE)) / 16.0
    columns = [float((np.nonzero(255 - f[..., 0])[1]).mean()) for f in frames]
    expected = [15.5 + 0.6 / pixel, 15.5, 15.5 - 0.6 / pixel]
    assert columns[:3] == pytest.approx(expected, abs=0.5)
    assert frames[0].shape == (32, 32, 3)
    assert tuple(frames[0][0, 0]) == (255, 255, 255)
