"""The masked autoencoder over views: its formulas in float64, and what a hidden view may tell."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn
from torch.nn import functional as F

from benchmarks import imagine
from benchmarks.imagine import (
    ImagineConfig,
    bench_imagine,
    imagine_words,
    imagined,
    judged_frames,
    psnr,
)
from benchmarks.pretraining import (
    AutoencoderTraining,
    new_autoencoder,
    schedule,
    train_autoencoder,
)
from madviz.errors import UserError
from madviz.runs.demonstrations import Dataset, Episode
from madviz.world_model.autoencoder import (
    LEAST_KEPT,
    AutoencoderConfig,
    MultiViewAutoencoder,
    autoencoder_loss,
    drawn_tokens,
    moving,
    newest,
    pictures_of,
    positions,
    reconstruction_loss,
    squares_of,
    symlog,
    whole_views,
)

ROOT = Path(__file__).resolve().parent.parent
SMALL = AutoencoderConfig(patch=14, width=16, layers=1, decoder_layers=1, heads=2)
TINY = AutoencoderConfig(patch=6, width=32, layers=1, decoder_layers=1, heads=2)
"""For pictures of 24 pixels."""
VIEWS = ("first", "third_a")


def network(seed: int = 0) -> MultiViewAutoencoder:
    torch.manual_seed(seed)
    model = MultiViewAutoencoder(SMALL, 9, torch.rand(2, 3, 84, 84)).eval()
    torch.nn.init.normal_(model.pixels.weight, std=0.1)
    return model


def pictures(batch: int = 2, views: int = 2, seed: int = 0) -> torch.Tensor:
    rng = np.random.default_rng(seed)
    return torch.from_numpy(rng.integers(0, 256, (batch, views, 9, 84, 84), np.uint8))


def seen_alike(count: int = 3, horizon: int = 20) -> Dataset:
    """Episodes in which both views show one bright square, at the same place."""
    data = Dataset(VIEWS, count, horizon)
    rng = np.random.default_rng(0)
    for _ in range(count):
        frames = np.full((horizon, 3, 24, 24), 60, np.uint8)
        places = rng.integers(0, 4, (horizon, 2))
        for frame, (row, column) in zip(frames, 6 * places, strict=True):
            frame[:, row : row + 6, column : column + 6] = 220
        rest = dict.fromkeys(("states", "actions", "labels", "places"), np.zeros((horizon, 2)))
        rewards = places[:, 0].astype(np.float32)
        data.add(Episode(dict.fromkeys(VIEWS, frames), **rest, rewards=rewards, success=True))
    return data


def test_nothing_of_a_hidden_view_reaches_what_is_drawn():
    model, views = network(), pictures()
    keep = whole_views(torch.tensor([True, False]), model.tokens_of_a_view, 2)
    before = model(views, keep)
    views[:, 1] = 255 - views[:, 1]
    after = model(views, keep)
    torch.testing.assert_close(after.pictures, before.pictures, rtol=0, atol=0)
    views[:, 0] = 255 - views[:, 0]
    assert not torch.equal(model(views, keep).pictures, before.pictures)


def test_nothing_of_a_hidden_patch_reaches_its_neighbours():
    model, views = network(), pictures(1)
    keep = torch.arange(1, 72)[None]  # All but the first patch of the first view.
    before = model(views, keep).pictures
    views[:, 0, :, :14, :14] = 0
    torch.testing.assert_close(model(views, keep).pictures, before, rtol=0, atol=0)


def test_what_has_learned_nothing_draws_the_mean():
    data = seen_alike()
    model = new_autoencoder(data, TINY, seed=1)
    views = data.views(np.arange(4))
    keep = whole_views(torch.tensor([True, False]), model.tokens_of_a_view, 4)
    mean = newest(data.usual_views()).mean(0)
    torch.testing.assert_close(model(views, keep).pictures, mean.expand(4, -1, -1, -1, -1))


@pytest.mark.parametrize("views", [1, 2, 5])
def test_kept_tokens_are_of_as_many_views_in_every_sample(views: int):
    tokens, generator = 36, torch.Generator().manual_seed(3)
    visible, shares, whole = set(), [], 0
    for _ in range(200):
        keep = drawn_tokens(generator, 8, views, tokens)
        of_views = [sorted(set((row // tokens).tolist())) for row in keep]
        assert len({len(one) for one in of_views}) == 1
        count = len(of_views[0])
        visible.add(count)
        share = keep.shape[1] / (count * tokens)
        shares.append(share)
        whole += share == 1
        assert all(len(set(row.tolist())) == keep.shape[1] for row in keep)
    assert visible == set(range(1, views + 1))
    assert min(shares) == pytest.approx(LEAST_KEPT, abs=0.06)
    assert 40 <= whole <= 95  # A third of 200, and those that round up.


def test_kept_tokens_are_a_function_of_the_generator():
    draws = [drawn_tokens(torch.Generator().manual_seed(seed), 4, 3, 36) for seed in (1, 1, 2)]
    assert torch.equal(draws[0], draws[1]) and not torch.equal(draws[0], draws[2])


def test_without_view_masking_every_view_keeps_some_tokens():
    generator, shares = torch.Generator().manual_seed(3), []
    for _ in range(100):
        keep = drawn_tokens(generator, 8, 3, 36, view_masking=False)
        assert all(len((row // 36).unique()) == 3 for row in keep)
        shares.append(keep.shape[1] / (3 * 36))
    assert min(shares) == pytest.approx(LEAST_KEPT, abs=0.06) and max(shares) == 1


def test_the_loss_hides_views_unless_told_otherwise():
    data = seen_alike()
    views, reward = data.views(np.arange(4)), torch.zeros(4)
    for masking in (True, False):
        model = new_autoencoder(data, replace(TINY, view_masking=masking), seed=1)
        kept: list[set[int]] = []

        def noted(views, keep, model=model, kept=kept):
            kept.append({len((row // model.tokens_of_a_view).unique()) for row in keep})
            return MultiViewAutoencoder.forward(model, views, keep)

        model.forward = noted
        generator = torch.Generator().manual_seed(0)
        for _ in range(20):
            autoencoder_loss(model, views, reward, generator)
        assert set.union(*kept) == ({1, 2} if masking else {2})


def test_all_views_are_hidden_alike_often():
    generator, hidden = torch.Generator().manual_seed(0), np.zeros(3)
    for _ in range(300):
        keep = drawn_tokens(generator, 16, 3, 36)
        for row in keep:
            hidden += ~np.isin(np.arange(3), (row // 36).unique().numpy())
    np.testing.assert_allclose(hidden / hidden.sum(), 1 / 3, atol=0.02)


def test_losses_are_those_of_an_independent_computation():
    rng = np.random.default_rng(0)
    drawn, truth = rng.uniform(0, 1, (2, 3, 2, 3, 4, 4))
    mean = truth.mean(0) + rng.choice([0.0, 0.2], (2, 3, 4, 4))
    moves = np.zeros((3, 2, 4, 4), bool)
    total, weights = np.zeros(2), np.zeros(2)
    for b, v, y, x in np.ndindex(3, 2, 4, 4):
        moves[b, v, y, x] = any(
            abs(truth[b, v, c, y, x] - mean[v, c, y, x]) > 10 / 255 for c in range(3)
        )
        weight = 21.0 if moves[b, v, y, x] else 1.0
        errors = [(drawn[b, v, c, y, x] - truth[b, v, c, y, x]) ** 2 for c in range(3)]
        total[v] += weight * sum(errors) / 3
        weights[v] += weight
    found = moving(torch.from_numpy(truth), torch.from_numpy(mean))
    np.testing.assert_array_equal(found.numpy(), moves)
    loss = reconstruction_loss(torch.from_numpy(drawn), torch.from_numpy(truth), found, 20.0)
    assert float(loss) == pytest.approx((total / weights).mean(), rel=1e-12)


def test_psnr_is_over_the_pixels_that_are_asked_for():
    truth, drawn = torch.zeros(1, 1, 3, 8, 8), torch.zeros(1, 1, 3, 8, 8)
    drawn[..., :4, :] = 0.1
    where = torch.zeros(1, 1, 8, 8, dtype=torch.bool)
    where[..., :4, :] = True
    assert float(psnr(drawn, truth, where)) == pytest.approx(20.0, abs=1e-4)
    everywhere = torch.ones_like(where)
    assert float(psnr(drawn, truth, everywhere)) == pytest.approx(20 + 10 * math.log10(2))
    assert float(psnr(drawn + 5, truth, where)) == pytest.approx(0.0)  # Never brighter than white.


def test_rewards_are_squeezed_symmetrically():
    found = symlog(torch.tensor([-10.0, 0.0, 10.0, 1000.0], dtype=torch.float64))
    expected = [-math.log(11), 0.0, math.log(11), math.log(1001)]
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-12)


def test_patches_and_positions_are_in_the_order_of_the_stem():
    model, views = network(), pictures(1, 2)
    everything = torch.arange(72)[None]
    tokens = model.tokens(views, everything)
    changed = views.clone()
    changed[0, 1, :, 14:28, 70:84] = 0  # Row 1, column 5 of the second view.
    different = (
        (model.tokens(changed, everything) != tokens).any(-1)[0].nonzero().flatten().tolist()
    )
    assert different == [36 + 6 + 5]
    patches = torch.zeros(1, 1, 36, 3 * 14 * 14)
    patches[0, 0, 11] = 1
    where = pictures_of(patches, 14)[0, 0, 0].nonzero()
    assert where.min(0).values.tolist() == [14, 70] and where.max(0).values.tolist() == [27, 83]
    marks = positions(6, 16)
    assert marks.shape == (36, 16)
    np.testing.assert_allclose(marks[11, 0], math.sin(1), rtol=1e-6)  # Row 1 at the fastest rate.
    np.testing.assert_allclose(marks[11, 8], math.sin(5), rtol=1e-6)  # Column 5.


def test_the_stem_is_two_convolutions_of_each_patch():
    model, views = network(), pictures(2)
    first, second = model.stem[0], model.stem[3]
    assert isinstance(first, nn.Linear) and isinstance(second, nn.Linear)
    pixels = views.flatten(0, 1).float() / 255 - 0.5
    kernel = first.weight.reshape(-1, 9, 2, 2)
    small = F.conv2d(pixels, kernel, first.bias, stride=2).relu()
    kernel = second.weight.unflatten(1, (7, 7, -1)).permute(0, 3, 1, 2)
    expected = F.conv2d(small, kernel, second.bias, stride=7).flatten(2).transpose(1, 2)
    expected = expected.reshape(2, 72, -1) + model.marks
    everything = torch.arange(72).expand(2, -1)
    torch.testing.assert_close(model.tokens(views, everything), expected)
    torch.testing.assert_close(model.tokens(views, everything[:, 30:50]), expected[:, 30:50])


def test_patches_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="80 pixels has no whole patches of 14"):
        MultiViewAutoencoder(AutoencoderConfig(), 9, torch.zeros(2, 3, 80, 80))


@pytest.mark.parametrize(
    ("sizes", "message"),
    [
        ({"patch": 16}, "expected patches of 2, 4, 6, 12, 14, 28, 42, 84 pixels.*found 16"),
        ({"patch": 7}, "found 7"),
        ({"width": 130, "heads": 2}, "a width .* that 4 and its 2 heads divide, found 130"),
        ({"heads": 3}, "3 heads divide, found 128"),
    ],
)
def test_sizes_that_do_not_go_together_are_refused_in_words(
    sizes: dict[str, Any], message: str
) -> None:
    with pytest.raises(UserError, match=message):
        AutoencoderConfig(**sizes)


def test_the_rate_rises_and_falls():
    rates = [schedule(step / 100) for step in range(101)]
    assert rates[0] < 1e-6 and max(rates) > 0.99 and rates[-1] < 1e-6
    assert rates.index(max(rates)) == 5


def test_a_view_is_imagined_from_another_after_training():
    data = seen_alike(6)
    model = new_autoencoder(data, TINY, seed=0)
    before = imagined(model, data, 30, seed=0)
    losses: list[float] = []
    config = AutoencoderTraining(updates=600, batch_size=16, learning_rate=3e-3)
    train_autoencoder(model, data, config, 0, lambda update, loss: losses.append(loss))
    after = imagined(model, data, 30, seed=0)
    assert losses[-1] < 0.5 * losses[0]
    assert [row["gain"] for row in before] == [0.0, 0.0]
    assert all(row["gain"] > 3 for row in after), after
    assert {(row["hidden"], row["from"]) for row in after} == {
        ("third_a", "first"),
        ("first", "third_a"),
    }


def test_controls_come_from_other_episodes():
    data = seen_alike(4)
    index, other = judged_frames(data, 50, seed=0)
    assert len(index) == 50 and (index // data.horizon != other // data.horizon).all()


def test_the_benchmark_judges_every_subset_of_every_hidden_camera():
    config = ImagineConfig(
        task="toy/reach",
        episodes=2,
        frames=12,
        training=AutoencoderTraining(updates=2, batch_size=2),
        network=SMALL,
    )
    found = bench_imagine(config)
    assert len(found["rows"]) == 9 and found["training"]["updates"] == 2
    hidden = [row["hidden"] for row in found["rows"] if "+" in row["from"]]
    assert sorted(hidden) == ["first", "third_a", "third_b"]
    assert found["passes"] is False and found["least_gain"] < 1
    words = imagine_words(found).splitlines()
    assert words[0].startswith("toy/reach: 2 updates in") and "NOT imagined" in words[-1]
    assert len(words) == 2 + 9 + 1


def test_the_benchmark_judges_what_an_included_policy_draws():
    found = bench_imagine(ImagineConfig(policy="toy-reach-mv-mwm-mv-mwm", frames=30))
    assert found["task"] == "toy/reach" and found["least_gain"] > 2
    assert found["network"]["width"] == 64 and "training" not in found
    assert imagine_words(found).startswith("toy/reach: toy-reach-mv-mwm-mv-mwm, 30 frames")


def test_a_policy_that_draws_nothing_is_not_judged():
    with pytest.raises(UserError, match="expected a policy that draws pictures, found metaworld-h"):
        bench_imagine(ImagineConfig(policy="metaworld-hammer-mad-light"))


def test_the_figures_in_the_text_of_the_benchmark_are_those_that_were_measured():
    measured = json.loads((ROOT / "results" / "imagine" / "toy-reach.json").read_text())
    written = [line.split() for line in (imagine.__doc__ or "").splitlines() if " gain " in line]
    assert written
    for hidden, *seen, drawn, _, mean, _, other, _, _, gain, _ in written:
        subset = "+".join(seen).replace(",", "")
        row = next(r for r in measured["rows"] if (r["hidden"], r["from"]) == (hidden, subset))
        found = [row[name] for name in ("imagined", "mean_picture", "other_episode", "gain")]
        assert [drawn, mean, other, gain] == [f"{number:.1f}" for number in found]


def test_newest_is_the_last_of_the_stack():
    views = pictures(1, 2)
    torch.testing.assert_close(newest(views)[0, 1], views[0, 1, 6:].float() / 255)


def test_squares_of_bytes_and_of_floats_are_the_same() -> None:
    views = torch.randint(0, 256, (2, 3, 6, 84, 84), dtype=torch.uint8)
    assert torch.equal(squares_of(views, 14).float(), squares_of(views.float(), 14))
