# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # 8. Look inside a rollout
#
# **Question: success says whether a policy works. How do you find out what it works *with*?**
#
# Five ways to look into one episode: the features, the pixels an action depends on, the Shapley
# value of each camera, a recording that you can play forth and back, and what a policy imagines of
# a camera that is missing. The policy is merged-only on hammer, the one that fails when cameras are
# missing; only the last part has another one, because only a world model imagines.
#
# Time: 50 minutes. Lesson 4 comes before this one.

# %%
import tempfile
from itertools import permutations
from pathlib import Path

import numpy as np

import madviz
from madviz import teaching
from madviz.analysis.saliency import saliency
from madviz.analysis.shapley import action_shapley
from madviz.subsets import mask_of, name_of
from madviz.teaching.imagining import foreseen_sheet, imagined_psnr, imagined_sheet
from madviz.teaching.inside import (
    norm_curves,
    record,
    report,
    saliency_sheet,
    shapley_curves,
    success_shapley,
)
from madviz.teaching.show import sheet, source
from madviz.widgets import Explorer, Predict, Viewer

teaching.begin()
VIEWER = False  # True shows rerun's viewer in part 4.
MAD, MERGED_ONLY = "metaworld-hammer-mad-light", "metaworld-hammer-merged-only-light"
mad, merged_only = madviz.load_policy(MAD), madviz.load_policy(MERGED_ONLY)
episode = list(teaching.moments(merged_only, seed=2000))
print(len(episode), "moments, success at the last one:", episode[-1].success)

# %% [markdown]
# ## 1. Features
#
# How large is the norm of each camera's feature, over the episode? (The network sums them, so a
# large one weighs more.)

# %%
norm_curves(episode)

# %%
norm_curves(list(teaching.moments(mad, seed=2000)))

# %% [markdown]
# The first figure is merged-only, the second MAD on the same seed. Compare how the cameras share
# the sum.
#
# ## 2. Which pixels matter?
#
# *Saliency* is a derivative: how much does the action change if a pixel changes a little? Bright
# is much. All cameras share one scale, so a camera that stays dark has little influence at this
# time step.

# %% tags=["prediction"]
guess = Predict(
    "On which camera does most of merged-only's saliency fall?",
    ["First person", "Third A", "Third B", "evenly on all"],
)
guess

# %%
now = episode[20]
sheet({teaching.named(camera): view.rgb for camera, view in now.views.items()})

# %%
saliency_sheet(now)

# %%
everything = np.ones(3, bool)
maps = [saliency(merged_only, m.stack, m.state, everything, "action") for m in episode[::20]]
sums = np.array(maps).sum((2, 3))  # One row per time step, one column per camera.
shares = (sums / sums.sum(1, keepdims=True)).mean(0)
cameras = [teaching.named(name) for name in merged_only.spec.streams]
guess.compare(", ".join(f"{n} {s:.2f}" for n, s in zip(cameras, shares, strict=True)))

# %% [markdown]
# In the saved run it falls almost evenly on all three. Keep that in mind for the next part. And
# MAD at the same step of its own episode:

# %%
saliency_sheet(teaching.moment_at(mad, seed=2000, step=20))

# %% [markdown]
# A warning: saliency says what a *small* change of a pixel does. A camera may matter as a whole
# although no single pixel of it does, and the other way round. It is a hint, not a proof.
#
# ## 3. What does each camera add?
#
# Take one camera away, and perhaps nothing happens, because another one shows the same. So add
# the cameras one by one, in every order, and note what each adds; the mean over all orders is the
# camera's *Shapley value*. With three cameras there are six orders and eight sets, and lesson 2
# showed that all eight are computed at every time step anyway.

# %%
source(action_shapley)

# %%
shapley_curves(episode)

# %% [markdown]
# The same can be asked about success. The eight sets were measured on 100 episodes each
# (shipped):

# %% tags=["prediction"]
guess_share = Predict(
    "MAD works with any camera. How is its success shared among the three?",
    ["All to First person", "A third each", "Nothing to any of them, as each can be spared"],
)
guess_share

# %%
streams = mad.spec.streams
values, shown = success_shapley(teaching.shipped(MAD), streams)
guess_share.compare(", ".join(f"{n} {w:.2f}" for n, w in zip(cameras, values.cameras, strict=True)))

# %%
shown

# %% [markdown]
# And merged-only. This is this lesson's number with its interval: First person's Shapley value.

# %%
values, shown = success_shapley(teaching.shipped(MERGED_ONLY), streams)
shown

# %%
print("First person alone:", teaching.in_words(*teaching.shipped(MERGED_ONLY)["first"]))
print("without First person:", teaching.in_words(*teaching.shipped(MERGED_ONLY)["third_a+third_b"]))
gaps = [np.linalg.norm(moment.action("first") - moment.action("all")) for moment in episode]
print(f"mean distance of its actions on First person alone: {np.mean(gaps):.2f}")

# %% [markdown]
# Read the two lines together: First person alone has next to no success, and yet it has the
# largest share. It is needed, but it is not enough; only the sum over all orders says so.
# Saliency shows none of that: it was spread almost evenly.
#
# ## 4. A recording
#
# Without First person from the start, merged-only never succeeded. Here it is dropped after 30
# decisions. The episode as a page in one file (pictures, curves, and the command that makes it
# again):

# %%
folder = Path(tempfile.mkdtemp())
report(MERGED_ONLY, folder, seed=2000, drop=["first@30"])

# %% [markdown]
# The same as a file for rerun's viewer, which can play it forth and back. The printed command,
# given in `folder`, opens it in a window. With `VIEWER = True` at the top it also appears here,
# served by this machine: it works without a network, but where there is one, its page asks its
# makers for fonts, news and statistics, so it is off by default. Its data uses a port of its own,
# which a Jupyter proxy does not pass on: if your browser is on another machine, download the file
# and open it there.

# %%
file = record(MERGED_ONLY, folder, seed=2000, drop=["first@30"])
print(f"rerun {file.name}   ({file.stat().st_size / 1e6:.1f} MB)")
viewer = Viewer(file) if VIEWER else None
viewer

# %% [markdown]
# ## 5. What does it imagine?
#
# The policies so far read pictures, and cannot say what a missing one would show. MV-MWM can: its
# encoder has learned to draw all cameras from some of them (a *masked autoencoder*), and a world
# model predicts what an action leads to. This one has learned the small task `toy/reach`: a blue
# hand has to reach an orange target on a board. First person rides on the hand; Third A and Third B
# look down on the whole board.

# %%
world_model = madviz.load_policy("toy-reach-mv-mwm-mv-mwm")
reach = list(teaching.moments(world_model, seed=2001))
imagined_sheet(reach[5], "third_b")

# %% [markdown]
# Left of each pair is what the camera really shows, right what is imagined from Third B alone. Most
# of a picture never changes, so a number for the whole picture would be high for anything. Only the
# pixels that move are judged: dB are a peak signal-to-noise ratio over them, and more is better.

# %% tags=["prediction"]
guess_camera = Predict(
    "From which camera alone is Third A imagined better?",
    ["First person", "Third B", "equally well from both"],
)
guess_camera

# %%
others = ("first", "third_b", "first+third_b")
guess_camera.compare(
    "; ".join(
        f"from {teaching.named(names)} {imagined_psnr(reach, 'third_a', names):.1f} dB"
        for names in others
    )
)

# %% [markdown]
# In the saved run Third B is better, by a little. First person shows the hand in its middle always,
# and the target only when it is near: where on the board they are, it does not show at the start.
# (The policy is also given the position of the hand as numbers, which helps it here.)
#
# The world model can go on without any picture: from step 4 on, it decides, predicts what follows,
# and decides again. Above is what Third A showed after so many decisions, below what was foreseen
# from First person and Third B.

# %%
foreseen_sheet(reach, step=4, subset="first+third_b", stream="third_a")

# %% [markdown]
# On the live page, choose the task `toy/reach` and this policy: every camera that you switch off
# shows what is imagined, and the tab *Inside* foresees 15 decisions.
#
# ## Play
#
# Find the first time step from which First person can be dropped and the episode still succeeds:
# play the episode several times, and drop it earlier and later.

# %%
explorer = Explorer(merged_only, seed=2000)
explorer

# %% [markdown]
# ## Exercise 1: six orders by hand
#
# Check what `success_shapley` says. `rate` below gives the success of merged-only with any of its
# cameras. Write `shapley`: in every order of `cameras`, what does `camera` add to those before it?
# Take the mean.

# %%
measured = teaching.shipped(MERGED_ONLY)


def rate(cameras):
    """rate(["first", "third_a"]) is a number from 0 to 1; rate([]) is that of no camera."""
    name = name_of(mask_of("+".join(cameras) or "none", streams), streams)
    successes, n = measured[name]
    return successes / n


# %% tags=["answer"]
def shapley(rate, camera, cameras):
    return ...


# %% tags=["solution"]
def shapley(rate, camera, cameras):
    before = [order[: order.index(camera)] for order in permutations(cameras)]
    return np.mean([rate([*there, camera]) - rate(there) for there in before])


# %% tags=["check"]
teaching.check("08.shapley", shapley)

# %%
for camera, label, value in zip(streams, cameras, values.cameras, strict=True):
    by_hand = shapley(rate, camera, streams)
    print(f"{label:12} by hand {by_hand:.3f}, success_shapley {value:.3f}")

# %% [markdown]
# ## Exercise 2: what "success without it" hides
#
# One of the three cameras can be taken away, and merged-only succeeds as often as before. Which?
# Print `rate` of the pairs. And does this camera add nothing, then?

# %% tags=["answer"]
spared = ...

# %% tags=["solution"]
spared = max(streams, key=lambda camera: rate([other for other in streams if other != camera]))

# %% tags=["check"]
teaching.check("08.spared", spared)

# %% [markdown] tags=["solution"]
# Third B can be spared (without it success is as high as with all cameras), and without Third A
# some success is lost. So "success without it" alone would say that Third B adds nothing; but once
# Third A is missing, Third B is what is left. And alone, Third A and Third B seem equally useless
# (neither ever succeeds), though the Shapley value of Third A is larger.
