from pathlib import Path

import pytest
from PIL import ImageFont

from npa_envs.errors import MissingDependencyError, NPAError
from npa_envs.tasks.targets import emoji
from npa_envs.tasks.targets.points import load_target


def test_emoji_are_told_from_words():
    for text in ("🦎", "❤", "❤️", "👩‍🚀", "🇨🇭", "1️⃣", "👍🏽", "☀"):
        assert emoji.is_emoji(text), text
    for text in ("", "gecko", "gëcko", "1", "守宫", "🦎" * 20):
        assert not emoji.is_emoji(text), text


def test_fonts_that_draw_no_emoji_are_clear_errors(monkeypatch, tmp_path):
    broken = tmp_path / "BrokenColorEmoji.ttf"
    broken.write_bytes(b"no font")
    for fonts, kind, message in (
        ([], MissingDependencyError, "apt install fonts-noto-color-emoji"),
        ([broken], NPAError, r"none of BrokenColorEmoji\.ttf"),
    ):
        monkeypatch.setattr(emoji, "find_emoji_fonts", lambda fonts=fonts: fonts)
        with pytest.raises(kind, match=message):
            load_target("🦎")


def test_emoji_in_a_font_without_colours_is_a_clear_error(monkeypatch):
    monkeypatch.setattr(emoji, "find_emoji_fonts", lambda: [Path("plain.ttf")])
    monkeypatch.setattr(emoji, "_open_font", lambda path: ImageFont.load_default(100))
    with pytest.raises(NPAError, match=r"in colour, but none of plain\.ttf"):
        load_target("☀")


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
