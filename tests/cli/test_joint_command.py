"""`npa-envs train co_morphogenesis2d`: options, files, runs that stop and go on."""

import json
import re
from dataclasses import replace

import pytest
import torch

from npa_envs.cli import common, main
from npa_envs.cli.train import parse_run
from npa_envs.errors import NPAError
from npa_envs.rule.files import load_rule, rule_metadata
from npa_envs.tasks.co_morphogenesis2d import CoMorphogenesis2DConfig
from npa_envs.training import RunFolder, load_config, preset, train

TINY = ["co_morphogenesis2d", "--preset", "tiny", "--no-report", "--no-progress"]
TINY += ["--iterations", "4"]


def parsed(*words):
    return parse_run("co_morphogenesis2d", common.first_options(words))[1]


def test_options_are_those_of_all_species():
    words = ("--targets", "ring", "flower", "gecko", "--distance", "0.5", "--eps", "0.25")
    config = parsed("--preset", "tiny", *words, "--seed", "3", "--particle-count", "64")
    base = preset("tiny").task
    assert config.task == CoMorphogenesis2DConfig(
        species=tuple(
            replace(base, target=target, eps=0.25, particle_count=64)
            for target in ("ring", "flower", "gecko")
        ),
        distance=0.5,
    )
    assert (config.seed, config.iterations) == (3, 40)
    assert (config.initial_rules, config.frozen) == ((), ())


def test_a_file_tells_species_apart_and_options_leave_what_they_do_not_name(tmp_path):
    path = tmp_path / "run.yaml"
    path.write_text(
        "species:\n- {particle_count: 77}\n- {alpha: 0.25, hidden_dim: 8}\n", encoding="utf-8"
    )
    # The value that the first species has must reach the second one, too.
    words = ("--preset", "tiny", "--config", str(path), "--hidden-dim", "32")
    first, second = parsed(*words).task.species
    assert (first.particle_count, first.alpha, first.hidden_dim) == (77, 0.5, 32)
    assert (second.particle_count, second.alpha, second.hidden_dim) == (128, 0.25, 32)
    assert (first.target, second.target) == ("ring", "heart")


def test_a_run_stopped_by_time_resumes_to_the_same_rules(tmp_path, capsys):
    words = ["train", *TINY, "--targets", "ring", "flower", "--milestones", "--out"]
    assert main([*words, str(tmp_path / "whole")]) == 0
    text = capsys.readouterr().out
    for name in ("rule-0.safetensors", "rule-1.safetensors"):
        assert f"rule        {tmp_path / 'whole' / name}" in text
    assert "--distances 0.8 --particle-count 256" in text
    assert main([*words, str(tmp_path / "parts"), "--max-seconds", "1e-9"]) == 0
    (command,) = re.findall(r"continue +npa-envs (train .*--resume)", capsys.readouterr().out)
    assert main([*command.split(), "--no-progress", "--no-report"]) == 0
    assert "finished: 4 iterations" in capsys.readouterr().out
    for number, target in enumerate(("ring", "flower")):
        whole, parts = (tmp_path / n / f"rule-{number}.safetensors" for n in ("whole", "parts"))
        expected, got = load_rule(whole).state_dict(), load_rule(parts).state_dict()
        assert all(torch.equal(got[name], expected[name]) for name in expected)
        assert json.loads(rule_metadata(whole)["config"])["task"]["target"] == target


def test_rules_are_gone_on_from_and_frozen_ones_stay(tmp_path):
    first, second = tmp_path / "first", tmp_path / "second"
    assert main(["train", *TINY, "--milestones", "--out", str(first)]) == 0
    paths = [str(first / f"rule-{number}.safetensors") for number in (1, 0)]
    words = ["train", *TINY, "--milestones", "--out", str(second)]
    assert main([*words, "--initial-rules", *paths, "--frozen", "0"]) == 0
    learned = [load_rule(second / f"rule-{number}.safetensors") for number in (0, 1)]
    given = [load_rule(path) for path in paths]
    assert torch.equal(learned[0].output.weight, given[0].output.weight)
    assert not torch.equal(learned[1].output.weight, given[1].output.weight)
    # What a rule passes on is the run of one rule.
    saved = json.loads(rule_metadata(second / "rule-0.safetensors")["config"])
    assert "initial_rules" not in saved
    assert preset("paper", **saved).task == preset("tiny").task
    config = load_config(second / "config.json", preset("tiny", "co_morphogenesis2d"))
    assert (config.initial_rules, config.frozen) == (tuple(paths), (0,))


def test_a_run_anew_leaves_no_rule_of_the_one_before(tmp_path):
    folder = RunFolder(tmp_path)
    kept = tmp_path / "rule-of-thumb.safetensors"
    for path in (folder.rule_of(0), folder.rule_of(2), kept):
        path.touch()
    folder.clear()
    assert list(tmp_path.iterdir()) == [kept]


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"frozen": [0]}, "frozen must name rules that were trained before"),
        ({"frozen": [2], "initial_rules": ["gecko"] * 2}, "from 0 to 1, got 2"),
        ({"frozen": [0, 1], "initial_rules": ["gecko"] * 2}, "must leave a rule that learns"),
        ({"initial_rules": ["gecko"]}, "one for each of 2 species, got 1"),
    ],
)
def test_what_cannot_be_started_from_is_refused(fields, message, tmp_path):
    config = preset("paper", "co_morphogenesis2d", **fields, out=tmp_path, pool_size=8)
    with pytest.raises(NPAError, match=message):
        train(config, "co_morphogenesis2d", progress=False)
