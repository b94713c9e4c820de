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
import numpy as np

import madviz
from madviz import teaching
from madviz.observation.streams import depth_code
from madviz.teaching.lessons import camera_sheet, feature_sheet, subset_table
from madviz.teaching.show import bars, source
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

# %% tags=["prediction"]
guess = Predict(
    "Whose action lies nearer to the action on everything, averaged over an episode?",
    ["colour only", "depth only", "about the same"],
)
guess

# %%
names = ("rgb", "depth", "first", "third_a", "third_b")
episode = list(teaching.moments(policy, seed=2000))
gaps = {
    name: np.mean([np.linalg.norm(m.action(name) - m.action("all")) for m in episode])
    for name in names
}
top = max(gaps.values())
bars(
    f"mean distance of actions to those on all streams; 1.0 = {top:.2f}",
    [*map(teaching.named, gaps)],
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
few = madviz.evaluate(policy, ["third_a.depth", "third_a.rgb"], episodes=3, seed=5000)
for name, counted in teaching.counts(few.rows).items():
    print(f"{teaching.named(name):14}", teaching.in_words(*counted))

# %% [markdown]
# ## Play
#
# Set every camera to *depth*, then one after the other to *off*. Then the same with *colour*.
# Which is the smallest set of streams with which the hammer still hits the nail?

# %%
explorer = Explorer(policy, seed=2000)
explorer

# %% [markdown]
# ## Exercise 1: count the sets
#
# How many of the 64 sets of streams have depth in them and no colour?

# %% tags=["answer"]
sets = ...

# %% tags=["solution"]
sets = 2**3 - 1

# %% tags=["check"]
teaching.check("05.sets", sets)

# %% [markdown]
# ## Exercise 2: the light goes out
#
# All three cameras send black in *colour*, with depth intact. The occlusions of this package cover
# a camera in both modalities, so do it by hand: write `dark`, which gets a stack and the names of
# its streams, such as `now.stack` and `policy.spec.streams`, and returns another stack.


# %% tags=["answer"]
def dark(stack, streams):
    return ...


# %% tags=["solution"]
def dark(stack, streams):
    black = stack.copy()
    black[[name.endswith(".rgb") for name in streams]] = 0
    return black


# %% tags=["check"]
teaching.check("05.dark", dark)

# %% [markdown]
# Is the action in the dark nearer to that of `depth` (colour is dropped) or to that of `all`?

# %%
encoded = policy.encode(dark(now.stack, policy.spec.streams), now.state)
action = policy.read(encoded, np.ones((1, 6), bool)).action[0]
for name in ("all", "depth", "rgb"):
    print(f"distance to the action on {name:5}: {np.linalg.norm(action - now.action(name)):.2f}")

# %% [markdown] tags=["solution"]
# Black colour is not absent colour: three features of black pictures are in the sum. If it is
# known that the light is out, it is better to drop the colour streams: the policy was trained on
# `depth`.
