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


@pytest.mark.parametrize(
    ("fonts", "error", "message"),
    [
        ([], MissingDependencyError, "apt install fonts-noto-color-emoji"),
        ([ImageFont.load_default(100)], NPAError, "draws in colour, but none of Aileron does"),
    ],
)
def test_emoji_that_no_font_draws_in_colour_are_clear_errors(monkeypatch, fonts, error, message):
    monkeypatch.setattr(emoji, "find_emoji_fonts", lambda: fonts)
    with pytest.raises(error, match=message):
        load_target("☀")


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
