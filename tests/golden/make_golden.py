"""Write the golden files anew: only at a commit whose results are known to be right.

Run by hand: `PYTHONPATH=.:tests OMP_NUM_THREADS=1 python tests/golden/make_golden.py`.
Worlds that are stored stay: 12 to 32 steps of shipped rules from the seeds of their tasks, with
random numbers that take no particle near a jump of the dynamics. The folders of unfinished runs
were written by `npa-envs train` with the options of `config.json`, killed after the first
checkpoint; `whole_log.jsonl` is the log of the same run without the kill.
"""

import json
import os
import time

import names
import numpy as np
import scenes
import torch


def main():
    """Write all of it."""
    torch.set_num_threads(1)
    # Helps of commands are wrapped no narrower than the test reads them.
    os.environ["COLUMNS"] = "200"
    with np.load(scenes.GOLDEN) as stored:
        arrays = {key: stored[key] for key in stored.files if key.startswith("world/")}
    for name in scenes.SCENES:
        began = time.perf_counter()
        arrays |= scenes.compute(name)
        print(f"{name}: {time.perf_counter() - began:.2f} s")
    np.savez_compressed(scenes.GOLDEN, **arrays)
    folder = scenes.GOLDEN.parent
    # The names that documents once took from the library must stay as well.
    content = json.loads((folder / "golden.json").read_text(encoding="utf-8"))
    content |= names.everything()
    text = json.dumps(content, indent=1, sort_keys=True) + "\n"
    (folder / "golden.json").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
