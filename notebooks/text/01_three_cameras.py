# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # 1. Three cameras, one policy
#
# **Question: what exactly does a robot policy see, and what of the world does it never see?**
#
# A robot arm in a simulator has to pick up a hammer and drive a nail in. It is steered by a
# *policy*: a function that gets pictures and a few numbers, and answers with an action. Here
# three cameras show the scene. In this lesson you follow their pictures from the scene to the
# network's first numbers.
#
# Time: 30 minutes. You need the included policy `metaworld-hammer-mad-light`, and nothing else.

# %%
import numpy as np

import madviz
from madviz import teaching
from madviz.agent.networks import Encoder
from madviz.drawing.colours import heat
from madviz.teaching.lessons import feature_sheet
from madviz.teaching.show import sheet, source, table
from madviz.widgets import Explorer, Predict

teaching.begin()
policy = madviz.load_policy("metaworld-hammer-mad-light")
now = teaching.moment_at(policy, seed=2000, step=20)

# %% [markdown]
# ## What the cameras see
#
# `now` is one time step of one episode, 20 decisions after its start. *First person* is mounted
# on the hand, *Third A* and *Third B* stand beside the table. The pictures have 84 x 84 pixels;
# the network gets no more. `sheet` draws pictures side by side, enlarged.

# %%
sheet({teaching.named(camera): view.rgb for camera, view in now.views.items()})

# %% [markdown]
# The simulator also knows how far away every pixel is, in metres. Below, dark is near and bright is
# far, over the range of interest of each camera. This policy does not get depth; lesson 5 has one
# that does.

# %%
shown = {}
for camera, view in now.views.items():
    (near, far), label = now.env.camera(camera).depth_range, teaching.named(camera)
    print(f"{label:12} dark is {near:.2f} m, bright is {far:.2f} m or more")
    shown[label] = heat((view.depth - near) / (far - near))
sheet(shown)

# %% [markdown]
# ## What a single picture cannot show

# %% tags=["prediction"]
guess = Predict(
    "The policy gets the last three pictures of every camera, not only the newest. "
    "What does the older pair add?",
    [
        "More detail of the same thing",
        "Which way things move, and how fast",
        "A view from elsewhere",
    ],
)
guess

# %%
oldest, middle, newest = teaching.frames_of(now.stack, policy.spec.streams.index("third_a"))
change = np.abs(newest.astype(int) - middle).mean(2)
sheet(
    {
        "two decisions ago": oldest,
        "one decision ago": middle,
        "now": newest,
        "what changed": heat(change / change.max()),
    }
)

# %%
guess.compare("the pictures differ only where something moved, so they show motion")

# %% [markdown]
# Three colour pictures are nine numbers per pixel. This is the network's whole visual input, with
# the axes camera, channel, row, column:

# %%
now.stack.shape

# %% [markdown]
# ## The robot's own state
#
# Beside the pictures there are 24 numbers that come from the robot itself (*proprioception*):
# where its hand is and how open its gripper. Each of three frames gives eight: four numbers, and
# the same four one simulator step before. Nothing in here says where the hammer or the nail is.

# %%
frames = ("two decisions ago", "one decision ago", "now")
parts = ("hand x, metres", "hand y", "hand z", "gripper opening")
parts += tuple(f"{part}, before" for part in parts)
rows = zip(parts, now.state.reshape(3, 8).T, strict=True)
table(["", *frames], [[part, *numbers] for part, numbers in rows])

# %% [markdown]
# ## Features
#
# One small network, the *encoder*, gets each camera's stack and turns it into 3136 numbers, the
# camera's *feature*. It is the same network for all cameras. Here are the three features as
# squares of 56 x 56, bright where a number is large. You cannot read them, but you can see that
# they differ, and that many numbers are zero: the last layer cuts off everything below zero.

# %%
encoded = policy.encode(now.stack, now.state)
encoded.features.shape

# %%
feature_sheet(now)

# %%
source(Encoder)

# %%
for camera, feature in zip(policy.spec.streams, encoded.features, strict=True):
    zeros = (feature == 0).mean()
    print(f"{teaching.named(camera):12} norm {np.linalg.norm(feature):.1f}, zeros {zeros:.0%}")

# %% [markdown]
# ## Play
#
# Press *Play*. Then switch *Third A* off, and on again; let it send black; let it freeze. Watch
# the first line of the table (what the policy does now) and how far every other subset of cameras
# would be from it. Some questions while it runs:
#
# 1. Which camera changes most from picture to picture?
# 2. When the hand covers the nail in one camera, does another one still see it?
# 3. Is *off* the same as *sends black*? (Lesson 4 is about that.)

# %%
explorer = Explorer(policy, seed=2000)
explorer

# %% [markdown]
# ## One number, and how far to trust it
#
# Does the policy work? Three episodes, run here and now (some seconds each):

# %%
tried = madviz.evaluate(policy, ["all"], episodes=3, seed=5000)
teaching.in_words(*teaching.counts(tried.rows)["all"])

# %% [markdown]
# Even three out of three leave a wide interval: a policy that works half the time has three
# successes in a row once in eight tries. The policy's card has 100 episodes, measured before and
# shipped with it:

# %%
teaching.in_words(*teaching.shipped("metaworld-hammer-mad-light")["all"])

# %% [markdown]
# ## Exercise 1: how much is that?
#
# How many numbers does the policy get in one time step, all cameras and the robot's own state
# together?

# %% tags=["answer"]
numbers = ...

# %% tags=["solution"]
numbers = now.stack.size + now.state.size

# %% tags=["check"]
teaching.check("01.numbers", numbers)

# %% [markdown]
# ## Exercise 2: take the motion away
#
# Write `still`: it gets a stack such as `now.stack` and returns one in which every camera has its
# newest picture three times.


# %% tags=["answer"]
def still(stack):
    return ...


# %% tags=["solution"]
def still(stack):
    return np.tile(stack[:, -3:], (1, 3, 1, 1))


# %% tags=["check"]
teaching.check("01.still", still)

# %% [markdown]
# How much does the action change without motion, compared with the change when Third A is dropped?
# Say which change is larger before you run it.

# %%
everything, no_third_a = np.array([[True, True, True]]), np.array([[True, False, True]])
action = policy.read(encoded, everything).action[0]
frozen = policy.read(policy.encode(still(now.stack), now.state), everything).action[0]
dropped = policy.read(encoded, no_third_a).action[0]
print(f"nothing moves:   {np.linalg.norm(frozen - action):.2f}")
print(f"Third A dropped: {np.linalg.norm(dropped - action):.2f}")

# %% [markdown] tags=["solution"]
# The two are of the same kind: both take something away that the policy is used to. Motion is
# also in the 24 numbers of the robot itself (its hand now and one simulator step before, for
# three frames), so the pictures are not its only source of it.
