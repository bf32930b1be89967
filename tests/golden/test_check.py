"""`make golden-check` sees a changed bit, and its scenes can still be made."""

import check
import numpy as np
import pytest
import wide

LEFT = {
    "a/x": np.array([1.0, np.nan, 0.0], np.float32),
    "a/words": np.array(["cut", "clump"]),
    "a/ends": np.array([True, False]),
}


def test_equal_arrays_are_equal_also_where_they_are_no_numbers():
    assert check.compare({name: array.copy() for name, array in LEFT.items()}, LEFT) == []


@pytest.mark.parametrize(
    ("name", "array"),
    [
        ("a/x", np.nextafter(LEFT["a/x"], np.float32(9))),
        ("a/x", np.array([1.0, np.nan, -0.0], np.float32)),
        ("a/x", LEFT["a/x"].astype(np.float64)),
        ("a/x", LEFT["a/x"][:2]),
        ("a/words", np.array(["cut", "push"])),
        ("a/ends", ~LEFT["a/ends"]),
        ("a/y", LEFT["a/x"]),
        ("a/EXCEPTION", np.asarray("ValueError: no")),
    ],
)
def test_each_change_is_reported(name, array):
    assert [entry[0] for entry in check.compare(LEFT | {name: array}, LEFT)] == [name]
    assert [entry[0] for entry in check.compare({}, LEFT)] == sorted(LEFT)


def test_scenes_and_the_names_that_they_take_from_the_library_are_there():
    scenes = wide.scenes()
    first = {name.split("/")[0] for name in scenes}
    assert {"rule", "kind", "env", "batch", "species", "train", "learn", "evaluate"} <= first
    found = {}
    wide.flat(scenes["brushes"](), "brushes", found)
    assert len(found) > 15
    assert all(np.isfinite(array).all() for array in found.values())
