"""A flag of maplab that has another name here, or none, is explained where it is typed."""

from __future__ import annotations

import pytest

from maplab_py.console.commands.flag_types import FLOAT
from maplab_py.console.commands.flags import Flag, parse_words
from maplab_py.console.commands.maplab_flags import explanation, former_flags, parse_table
from maplab_py.errors import FlagError

FLAGS = {"image_scale": Flag("image_scale", FLOAT, 1.0)}


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (
            "rovioli_use_6dof_localization",
            r"^rovioli has no flag --rovioli_use_6dof_localization: here it is "
            r"--localization_mode \(pose instead of vil\)$",
        ),
        (
            "visualize_map",
            "^rovioli has no flag --visualize_map: here it is --rovioli_visualize_map$",
        ),
        (
            "set_imu_bias_to_zero",
            "^rovioli has no flag --set_imu_bias_to_zero: maplab's flag is not needed here: "
            "biases are estimated$",
        ),
        ("image_scal", "^rovioli has no flag --image_scal; did you mean --image_scale"),
    ],
)
def test_an_unknown_flag_is_explained(name: str, message: str) -> None:
    with pytest.raises(FlagError, match=message):
        parse_words([f"--{name}=1"], FLAGS, "rovioli")


def test_reasons_continue_the_sentence() -> None:
    for name, flag in former_flags().items():
        text = explanation(name)
        assert text.startswith(": ")
        assert not text.endswith(".")
        assert (flag.new_name or flag.note) in text
    assert explanation("lc_of_nowhere") == ""


@pytest.mark.parametrize(
    "line", ["a\tdropped\t", "a\trenamed\t", "a, a\tdropped\tno", "a\tkept\tno", "a"]
)
def test_a_wrong_table_is_refused(line: str) -> None:
    with pytest.raises(ValueError, match=r"'?a'?|unpack|kept"):
        parse_table(line)
