"""A method's own options: on the command line, in a plan, in config.json and in older spellings."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import tyro

from madviz import cli
from madviz.agent.agent import Agent
from madviz.agent.merges.vib import BottleneckEncoder, VibOptions
from madviz.agent.networks import NetworkConfig
from madviz.agent.sizes import OwnOptions
from madviz.envs.registry import SETTINGS
from madviz.errors import UserError
from madviz.policies.checkpoint import describe, load_policy, save_policy
from madviz.training.config import RECIPES, TrainConfig, command, default_config, resolve
from madviz.training.light import LightConfig
from madviz.world_model.sizes import AutoencoderConfig, MvMaeOptions
from tests.checkpoints import make_config
from tests.checkpoints import saved as saved_mad

STREAMS = SETTINGS["three"].streams


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("--method vib", VibOptions(64, 0.01)),
        ("--method=vib --recipe=paper", VibOptions(3136, 10.0)),
        ("--method merged-only --merge vib", VibOptions(64, 0.01)),
        ("--method mv-mae", MvMaeOptions()),
        ("--method mv-mwm --recipe mv-mwm", OwnOptions()),
        ("", OwnOptions()),
    ],
)
def test_a_command_line_has_the_options_of_its_method(words: str, expected: OwnOptions) -> None:
    assert default_config(words.split()).own == expected
    assert cli.parse("train", words.split()).own == expected


def test_tyro_reads_them_from_the_default_instance_as_it_is() -> None:
    words = ["--method", "mv-mae", "--own.autoencoder.layers", "2", "--own.end-to-end"]
    default = default_config(words)
    own = tyro.cli(TrainConfig, default=default, args=words).own
    assert own == MvMaeOptions(AutoencoderConfig(layers=2), end_to_end=True)


def test_an_older_spelling_is_read_with_a_note(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--method", "vib", "--light.bottleneck-dim", "8", "--light.kl-weight=0.5"]
    assert cli.parse("train", words).own == VibOptions(8, 0.5)
    notes = capsys.readouterr().err
    assert "--light.bottleneck-dim is now --own.bottleneck-dim" in notes
    old = ["--method", "mv-mae", "--light.autoencoder.no-view-masking", "--light.end-to-end"]
    own = cli.parse("train", old).own
    assert own == MvMaeOptions(AutoencoderConfig(view_masking=False), end_to_end=True)


@pytest.mark.parametrize("option", ["--own.kl-weight", "--paper.kl-weight"])
def test_a_method_without_any_refuses_them_in_one_line(option: str) -> None:
    with pytest.raises(UserError, match="that has options of its own .vib, mv-mae.*'mad'"):
        cli.parse("train", ["--recipe", "paper", option, "3"])
    with pytest.raises(UserError, match="merge 'sum', which are none, found VibOptions"):
        resolve(TrainConfig("toy/reach", own=VibOptions()))
    with pytest.raises(UserError, match="which are VibOptions, found MvMaeOptions"):
        resolve(TrainConfig("toy/reach", "vib", own=MvMaeOptions()))


def test_a_plan_has_them_with_the_defaults_of_its_recipe() -> None:
    assert resolve(TrainConfig("toy/reach", "vib")).networks.own == VibOptions(64, 0.01)
    paper = TrainConfig("toy/reach", "vib", "paper")
    assert resolve(paper).networks.own == VibOptions(3136, 10.0)
    assert "--own" not in command(replace(paper, own=VibOptions()))
    asked = replace(paper, own=VibOptions(64, 10.0))
    assert command(asked).endswith("--own.bottleneck-dim 64")
    assert resolve(TrainConfig("toy/reach")).networks.own == OwnOptions()


def test_a_command_that_is_given_away_has_no_path_of_this_machine() -> None:
    light = LightConfig(episodes="/home/x/run")
    config = TrainConfig(cameras=Path("/home/x/c.toml"), light=light)
    assert "/home" not in command(config) and "c.toml" in command(config)
    assert "/home/x/c.toml" in command(config, given_away=False)


def saved_vib(folder: Path) -> Path:
    networks = NetworkConfig(6, 2, hidden_dim=8, own=VibOptions(4, 0.3))
    agent = Agent(networks, merge="vib", streams=STREAMS)
    return save_policy(folder / "p", agent, make_config(networks=networks, merge="vib"))


def test_config_json_has_the_sizes_and_nothing_else_of_them(tmp_path: Path) -> None:
    folder = saved_vib(tmp_path)
    networks = json.loads((folder / "config.json").read_text())["networks"]
    assert networks["bottleneck_dim"] == 4 and not {"kl_weight", "own"} & set(networks)
    encoder = load_policy(folder).agent.encoder  # type: ignore[attr-defined]
    assert isinstance(encoder, BottleneckEncoder) and encoder.latent == 4
    mad = json.loads((saved_mad(tmp_path) / "config.json").read_text())["networks"]
    assert "bottleneck_dim" not in mad and "own" not in mad


def edit(folder: Path, **sizes: object) -> None:
    file = folder / "config.json"
    config = json.loads(file.read_text())
    config["networks"] |= sizes
    file.write_text(json.dumps(config))


def test_an_older_file_holds_the_sizes_of_every_merge(tmp_path: Path) -> None:
    folder = saved_mad(tmp_path)
    edit(folder, bottleneck_dim=3136, end_to_end=False, autoencoder={"patch": 14}, world_model={})
    load_policy(folder)


def test_sizes_that_nobody_knows_or_of_another_type_are_refused(tmp_path: Path) -> None:
    folder = saved_vib(tmp_path)
    edit(folder, bottleneck_dim="wide")
    with pytest.raises(UserError, match="'networks.bottleneck_dim' to be a whole number"):
        load_policy(folder)
    edit(folder, bottleneck_dim=4, kl_weight=1.0)
    with pytest.raises(UserError, match="networks that cannot be built: unknown size 'kl_weight'"):
        describe(folder)


def test_the_fields_of_the_configuration_are_the_table_of_recipes() -> None:
    assert list(RECIPES) == ["light", "paper", "paper-vectorised", "mv-mwm"]
    for recipe in RECIPES.values():
        options = getattr(TrainConfig(), recipe.options)
        assert 0 <= options.alpha <= 1 and callable(recipe.train)
