"""Pictures of digits, and the clouds of points that are made of them."""

import numpy as np
import pytest
import torch
from support.small_digits import COUNTS, idx, pictures, write_idx

from npa_envs.errors import NPAError
from npa_envs.tasks.targets.digit_clouds import (
    PointClouds,
    _farthest_one_by_one,
    _farthest_points,
    augmented,
    load_clouds,
    load_pictures,
    read_idx,
)


def clouds_of(ink, particle_count, **options):
    """Return the clouds of pictures that have no classes."""
    return PointClouds(ink, np.zeros(len(ink), np.int64), particle_count, **options)


def write_training_files(folder, images, labels):
    (folder / "train-images-idx3-ubyte").write_bytes(idx(images))
    (folder / "train-labels-idx1-ubyte").write_bytes(idx(labels))


def test_idx_files_are_read_as_they_were_written(folder, monkeypatch):
    # A tilde is the user's home.
    monkeypatch.setenv("HOME", str(folder.parent))
    monkeypatch.setenv("USERPROFILE", str(folder.parent))
    for seed, (split, part) in enumerate((("train", "train"), ("test", "t10k"))):
        images, label = pictures(COUNTS[part], seed)
        ink, read = load_pictures(f"~/{folder.name}", split)
        assert np.array_equal(np.round(ink * 255), images)
        assert np.array_equal(read, label)
        assert (ink.dtype, read.dtype) == (np.float32, np.int64)
    clouds, again = (load_clouds(str(folder), "test", 20, device=torch.device("cpu")) for _ in "12")
    assert clouds is again
    assert clouds.x.shape == (18, 20, 2)
    assert clouds.label.tolist() == [0, 1, 2] * 6


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "begins with nothing"),
        (b"\0\0\x0d\x01\0\0\0\x01\0", "IDX file of unsigned bytes"),
        (b"\0\0\x08\x03\0\0", "IDX file of unsigned bytes"),
        (idx(np.zeros((2, 3), np.uint8))[:-1], r"must hold 6 bytes of data.*2 x 3.*holds 5"),
        (b"\x1f\x8bnonsense", "cannot read the IDX file"),
    ],
)
def test_a_damaged_idx_file_is_a_clear_error(tmp_path, content, message):
    path = tmp_path / "file"
    path.write_bytes(content)
    with pytest.raises(NPAError, match=message):
        read_idx(path)


def test_folders_without_data_are_clear_errors(tmp_path):
    with pytest.raises(NPAError, match="must hold MNIST's file train-images-idx3-ubyte or"):
        load_pictures(str(tmp_path))
    write_training_files(tmp_path, np.zeros((3, 2), np.uint8), np.zeros(3, np.uint8))
    with pytest.raises(NPAError, match=r"must hold pictures \[M, H, W\].*got \[3, 2\]"):
        load_pictures(str(tmp_path))


def test_mnist_is_read_from_the_folder_of_torchvision_and_never_downloaded(tmp_path):
    raw = tmp_path / "MNIST" / "raw"
    raw.mkdir(parents=True)
    write_idx(raw)
    for split in ("train", "test"):
        ink, _ = load_pictures("mnist", split, folder=str(tmp_path))
        assert np.array_equal(ink, load_pictures(str(raw), split)[0])
    with pytest.raises(NPAError, match=r"nothing is downloaded unasked.*MNIST.'empty', download"):
        load_pictures("mnist", folder="empty")


def test_the_built_in_digits_are_split_fairly_and_without_overlap():
    pytest.importorskip("sklearn")
    (train, labels), (test, test_labels) = (load_pictures("digits", s) for s in ("train", "test"))
    assert (len(labels), len(test_labels)) == (1438, 359)
    assert 35 <= np.bincount(test_labels).min() <= np.bincount(test_labels).max() <= 37
    assert train.max() == 1.0
    assert not {picture.tobytes() for picture in train} & {picture.tobytes() for picture in test}


@pytest.mark.parametrize("choose", [_farthest_points, _farthest_one_by_one])
def test_each_point_is_as_far_as_can_be_from_those_before(choose):
    random = torch.Generator().manual_seed(0)
    candidates = torch.randint(2048, (3, 60, 2), generator=random).float()
    counts = torch.tensor([60, 31, 5])
    chosen = choose(candidates, counts, 9).double()
    assert torch.equal(chosen, _farthest_points(candidates, counts, 9))
    for cloud, points, count in zip(chosen, candidates.double(), counts.tolist(), strict=True):
        assert torch.equal(cloud[0], points[0])
        for k in range(1, min(9, count)):
            nearest = torch.cdist(points[:count], cloud[:k]).amin(1)
            assert torch.cdist(cloud[k : k + 1], cloud[:k]).min() == nearest.max()
        # Where there are no more, those that there are come again, and nothing else.
        assert {tuple(p) for p in cloud.tolist()} <= {tuple(p) for p in points[:count].tolist()}


def test_points_lie_on_the_ink_and_the_first_row_is_the_highest():
    ink = np.zeros((2, 8, 4), np.float32)
    ink[0, :2, 3] = 0.7
    ink[1, 6:, :] = 0.2
    clouds = clouds_of(ink, 40)
    x = clouds.x
    # Enlarged bilinearly, ink ends within a quarter of a pixel of the pixels' edges.
    assert x[0, :, 0].min() > (3 - 0.26) / 8
    assert x[0, :, 0].max() < 4 / 8
    assert x[0, :, 1].min() > (6 - 0.26) / 8
    assert x[1, :, 1].max() < (2 + 0.26) / 8
    assert x[1, :, 0].max() < 0.5
    # Shares of the picture: 2 of 32 pixels and 8 of 32, measured 0.154.
    assert 2.0 * clouds.coverage == pytest.approx((2 / 32 + 8 / 32) / 2, abs=0.02)
    with pytest.raises(NPAError, match="empty one at 1"):
        clouds_of(np.stack([ink[0], 0 * ink[0]]), 10)


@pytest.mark.parametrize("shape", [(12, 12), (3, 12), (12, 6)])
def test_coverage_is_the_fraction_of_the_unit_square(folder, tmp_path, shape):
    write_training_files(tmp_path, np.full((2, *shape), 255, np.uint8), np.zeros(2, np.uint8))
    clouds = load_clouds(str(tmp_path), "train", 20, device=torch.device("cpu"))
    assert clouds.coverage == shape[0] * shape[1] / max(shape) ** 2
    assert load_clouds(str(folder), "train", 20, device=torch.device("cpu")).coverage < 1.0


def test_a_cloud_does_not_depend_on_the_others_nor_on_the_device(device, monkeypatch):
    images = np.concatenate([pictures(6, 3)[0], pictures(6, 4)[0] // 2]).astype(np.float32)
    x = clouds_of(images, 100, sample_seed=5).x
    for k in (0, 1, 11):
        assert torch.equal(clouds_of(images[k : k + 1], 100, sample_seed=5).x[0], x[k])
    monkeypatch.setattr("npa_envs.tasks.targets.digit_clouds.BATCH_SIZES", {"cpu": 5, "cuda": 5})
    clouds = clouds_of(images, 100, sample_seed=5, device=device)
    # Those that are asked for first, and again, are the same as all at once.
    some = torch.tensor([3, 7, 3], device=device)
    assert torch.equal(clouds.points(some).cpu(), x[[3, 7, 3]])
    assert torch.equal(clouds.x.cpu(), x)
    assert not torch.equal(clouds_of(images, 100, sample_seed=6).x, x)


def test_clouds_first_chosen_in_inference_mode_are_plain_tensors(folder):
    with torch.inference_mode():
        clouds = load_clouds(str(folder), "test", 30, device=torch.device("cpu"))
        first = clouds.points(torch.tensor([0]))
    assert torch.equal(clouds.x[:1], first)
    assert not clouds.x.is_inference()


def test_turned_clouds_keep_their_distances_and_their_middle():
    x = torch.rand(40, 9, 2, dtype=torch.float64)
    turned = augmented(x, 30.0, 0.0, 0.0, torch.Generator().manual_seed(1))
    torch.testing.assert_close(torch.cdist(turned, turned), torch.cdist(x, x))
    torch.testing.assert_close((turned - 0.5).norm(dim=-1), (x - 0.5).norm(dim=-1))
    angles = [torch.atan2(*(cloud - 0.5)[:, 0].T.flip(0)) for cloud in (turned, x)]
    turn = torch.rad2deg(torch.remainder(angles[0] - angles[1] + torch.pi, 2 * torch.pi)) - 180
    assert -30.0 <= turn.min() < -15.0
    assert 15.0 < turn.max() <= 30.0


def test_stretched_clouds_are_linear_and_shaken_ones_are_off_by_a_little():
    x = torch.rand(200, 3, 2, dtype=torch.float64)
    generator = torch.Generator().manual_seed(1)
    stretched = augmented(x, rotation=0.0, stretch=0.2, jitter=0.0, generator=generator) - 0.5
    maps = torch.linalg.lstsq(x - 0.5, stretched).solution.mT
    torch.testing.assert_close(torch.einsum("bij,bnj->bni", maps, x - 0.5), stretched)
    off = maps - torch.eye(2)
    assert off.abs().max() <= 0.2 + 1e-9
    assert off[:, 1, 0].abs().max() < 1e-9
    for i, j in ((0, 0), (1, 1), (0, 1)):
        assert off[:, i, j].abs().max() > 0.18
    shaken = augmented(x, rotation=0.0, stretch=0.0, jitter=0.01, generator=generator) - x
    # 1200 numbers: the standard deviation is within 10 % but for one case in a million.
    assert shaken.std() == pytest.approx(0.01, rel=0.1)
