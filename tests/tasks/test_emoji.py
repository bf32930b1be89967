from __future__ import annotations

from pathlib import Path

import pytest
from PIL import ImageFont

from npa_envs.errors import MissingDependencyError, NPAError
from npa_envs.tasks.targets import emoji
from npa_envs.tasks.targets.points import load_target


@pytest.mark.parametrize("text", ["🦎", "❤", "❤️", "👩‍🚀", "🇨🇭", "1️⃣", "👍🏽", "☀"])
def test_emoji_are_told_from_words(text):
    assert emoji.is_emoji(text)


@pytest.mark.parametrize("text", ["", "gecko", "gëcko", "1", "守宫", "🦎" * 20])
def test_words_are_told_from_emoji(text):
    assert not emoji.is_emoji(text)


def test_emoji_without_a_font_names_the_debian_package(monkeypatch):
    monkeypatch.setattr(emoji, "find_emoji_fonts", lambda: [])
    with pytest.raises(MissingDependencyError, match="apt install fonts-noto-color-emoji"):
        load_target("🦎")


def test_emoji_in_a_font_without_colours_is_a_clear_error(monkeypatch):
    monkeypatch.setattr(emoji, "find_emoji_fonts", lambda: [Path("plain.ttf")])
    monkeypatch.setattr(emoji, "_open_font", lambda path: ImageFont.load_default(100))
    with pytest.raises(NPAError, match=r"in colour, but none of plain\.ttf"):
        load_target("☀")


def test_font_that_does_not_open_is_passed_over(monkeypatch, tmp_path):
    broken = tmp_path / "BrokenColorEmoji.ttf"
    broken.write_bytes(b"no font")
    monkeypatch.setattr(emoji, "find_emoji_fonts", lambda: [broken])
    with pytest.raises(NPAError, match=r"none of BrokenColorEmoji\.ttf"):
        load_target("🦎")


def test_fonts_in_the_home_folder_are_found(monkeypatch, tmp_path):
    font = tmp_path / ".local/share/fonts/deep/MyColorEmoji.ttf"
    font.parent.mkdir(parents=True)
    font.write_bytes(b"")
    monkeypatch.setattr(emoji.sys, "platform", "linux")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert font.resolve() in emoji.find_emoji_fonts()


needs_emoji_font = pytest.mark.skipif(
    not emoji.find_emoji_fonts(), reason="no colour-emoji font is installed"
)


@needs_emoji_font
def test_lizard_emoji_is_green():
    target = load_target("🦎")
    red, green, blue = target.colours.mean(dim=0)
    assert green > max(red, blue) + 0.1
    assert abs(target.point_count - 4096) <= 40
    assert target.name == "🦎"


@needs_emoji_font
def test_joined_emoji_is_one_picture_and_two_emoji_are_a_clear_error():
    assert load_target("👩‍🚀", point_count=1000).point_count > 900
    with pytest.raises(NPAError, match="must be one emoji"):
        load_target("🦎🦎")
