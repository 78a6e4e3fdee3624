"""Settings: defaults are valid, files state differences, mistakes are named."""

import itertools
from pathlib import Path

import pytest

from edslam_ti.config import Config, read_differences
from edslam_ti.datasets import FORMATS
from edslam_ti.errors import ConfigError

CONFIGS = Path(__file__).parents[1] / "configs"


def test_saved_settings_load_as_the_same_settings(tmp_path: Path) -> None:
    config = Config().updated({"scene": "room0", "tracking": {"num_patches": 7}})
    (tmp_path / "c.yaml").write_text(config.to_yaml())
    assert Config().updated(read_differences(tmp_path / "c.yaml")) == config


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.yaml")), ids=lambda path: path.name)
def test_each_dataset_file_is_valid_and_states_only_differences(path: Path) -> None:
    differences = read_differences(path)
    assert path.stem in FORMATS
    defaults = Config().model_dump()

    def check(values: dict[str, object], base: dict[str, object]) -> None:
        for key, value in values.items():
            if isinstance(value, dict):
                check(value, base[key])  # type: ignore[arg-type]
            else:
                assert value != base[key], f"{key} is the default"

    check(differences, defaults)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("sceen: room0", r"unknown key 'sceen'; did you mean 'scene'\?"),
        ("tracking: {num_patch: 3}", r"unknown key 'tracking\.num_patch'; did you mean 'num_patches'\?"),
        ("tracking: {num_patches: 0}", r"tracking\.num_patches: .* greater than or equal to 1, got 0"),
        ("start: .nan", r"start: .* got nan"),
        ("tracking: 3", r"tracking: "),
        ("- 1", r"expected a mapping"),
        ("a: [", r"not readable as YAML"),
    ],
)
def test_mistakes_in_a_file_are_named_in_one_line(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "c.yaml").write_text(text)
    with pytest.raises(ConfigError, match=message) as caught:
        read_differences(tmp_path / "c.yaml")
    assert "\n" not in str(caught.value)


BOMB = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{b}: &{b} [{', '.join([f'*{a}'] * 9)}]\n" for a, b in itertools.pairwise("abcdefghi")
)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "message"),
    [
        (BOMB.replace("\ni: &i", "\nscene: &i"), r"scene: Input should be a valid string, got \[\["),
        ("scene: " + "x" * 1_000_000 + "\nseed: -1\n", r"seed: .*greater than or equal to 0, got -1"),
        ("seed: '" + "9" * 1_000_000 + "x'\n", r"seed: .*, got '999.*\.\.\.999.*x'"),
        ("? " + "x" * 1_000_000 + "\n: 1\n", r"unknown key 'xxx.* \.\.\.'"),
        ("[" * 3000, r"not readable as YAML"),
        ("seed: " + "9" * 5000, r"not readable as YAML"),
        ("max_interval: 1.0e-9", r"max_interval: .*greater than or equal to 0\.001, got 1e-09"),
        ("threads: 1000000000", r"threads: .*less than or equal to 256"),
        ("contrast_threshold: 1.0e-300", r"contrast_threshold: .*greater than or equal to 0\.001"),
    ],
)
def test_messages_about_settings_are_short(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "c.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=message) as caught:
        read_differences(path)
    assert len(str(caught.value)) <= 1000
    assert str(caught.value).isprintable()
