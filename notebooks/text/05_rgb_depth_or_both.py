# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # 5. Colour, depth, or both
#
# **Question: is a camera that measures distance more useful than one that sees colour? And can
# one policy work with either?**
#
# The policy of this lesson has three cameras in two modalities: six *streams*. It was trained to
# work from all of them, from each alone, from each camera, and from each modality.
#
# Time: 30 minutes.

# %%
import madviz
from madviz import teaching
from madviz.observation.streams import depth_code
from madviz.teaching.lessons import (
    action_gaps,
    camera_sheet,
    feature_sheet,
    measure,
    subset_table,
)
from madviz.teaching.show import bars, source, table
from madviz.widgets import Explorer, Predict

teaching.begin()
NAME = "metaworld-hammer-mad-three-rgbd-light"
policy = madviz.load_policy(NAME)
now = teaching.moment_at(policy, seed=2000, step=20)
policy.spec.streams

# %% [markdown]
# ## The same time step twice

# %%
camera_sheet(now)

# %%
camera_sheet(now, "depth")

# %% [markdown]
# Distance reaches the policy as a number from 0 to 255 over a range that belongs to the camera: up
# to 0.45 m for First person, 0.5 to 1.7 m for Third A, 0.8 to 2.0 m for Third B. The range does
# not change from picture to picture: otherwise half a metre would be bright today and dark
# tomorrow.

# %%
source(depth_code)

# %% [markdown]
# Three equal channels of that go through the *same* encoder as colour. Its features:

# %%
feature_sheet(now, size=120)

# %% [markdown]
# ## 64 sets of streams
#
# Six streams can be combined in 64 ways, and the policy's action is computed for all of them at
# every time step. Here are those the policy was trained on:

# %%
subset_table(now, every=False)

# %%
guess = Predict(
    "Whose action lies nearer to the action on everything, averaged over an episode?",
    ["colour only", "depth only", "about the same"],
)
guess

# %%
gaps = action_gaps(policy, 2000, ["rgb", "depth", "first", "third_a", "third_b"])
top = max(gaps.values())
bars(
    f"mean distance of actions to those on all streams; 1.0 = {top:.2f}",
    list(gaps),
    {"one episode": [gap / top for gap in gaps.values()]},
)

# %%
guess.compare(f"colour {gaps['rgb']:.2f}, depth {gaps['depth']:.2f}")

# %% [markdown]
# A different action is not yet a worse one. What counts is success.
#
# ## Success
#
# Shipped with the policy (100 episodes each, measured before):

# %%
shipped = teaching.shipped(NAME)
teaching.success_table({"shipped": shipped})

# %%
print("depth only:", teaching.in_words(*shipped["depth"]))

# %% [markdown]
# A hundred out of a hundred is not certainty: a policy that fails once in thirty would sometimes
# look like this. The interval's lower end says so.
#
# The card does not say how well single streams do. So measure two, three episodes each, here and
# now:

# %%
few = measure(policy, ["third_a.depth", "third_a.rgb"], 3)
table(["stream", "success"], [[name, teaching.in_words(*one)] for name, one in few.items()])

# %% [markdown]
# ## Play
#
# Set every camera to *depth*, then one after the other to *off*. Then the same with *colour*.
# Which is the smallest set of streams with which the hammer still hits the nail?

# %%
explorer = Explorer(policy, seed=2000)
explorer

# %% [markdown]
# ## Exercise
#
# Swap the light for distance: let all three cameras send black in *colour* only, with depth
# intact. The occlusions of this package blacken a camera's every modality, so do it by hand: take
# `now.stack`, set the streams that end in `.rgb` to zero, and encode. Is the action nearer to
# that of `depth` (colour dropped) or to that of `all`? A solution is in
# `solutions/05_rgb_depth_or_both.py`.
