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
# Time: 30 minutes. You need the bundled policy `metaworld-hammer-mad-light`, and nothing else.

# %%
import madviz
from madviz import teaching
from madviz.agent.networks import Encoder
from madviz.teaching.lessons import camera_sheet, feature_sheet, measure, stack_sheet, state_table
from madviz.teaching.show import source, table
from madviz.widgets import Explorer, Predict

teaching.begin()
policy = madviz.load_policy("metaworld-hammer-mad-light")
now = teaching.moment_at(policy, seed=2000, step=20)

# %% [markdown]
# ## What the cameras see
#
# `now` is one time step of one episode, 20 decisions after its start. *First person* is mounted
# on the hand, *Third A* and *Third B* stand beside the table. The pictures have 84 x 84 pixels;
# the network gets no more.

# %%
camera_sheet(now)

# %% [markdown]
# The simulator also knows how far away every pixel is. Dark is near, bright is far. This policy
# does not get depth; lesson 5 has one that does.

# %%
camera_sheet(now, "depth")

# %% [markdown]
# ## What a single picture cannot show

# %%
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
stack_sheet(now, "third_a")

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
# where its hand is and how open its gripper. Each of three frames gives eight. Nothing in here
# says where the hammer or the nail is.

# %%
frames = ("two decisions ago", "one decision ago", "now")
parts = ("hand x, metres", "hand y", "hand z", "gripper opening")
halves = ("", ", one simulator step before")
state_table(now, [f"{f}: {part}{half}" for f in frames for half in halves for part in parts])

# %% [markdown]
# ## Features
#
# One small network, the *encoder*, gets each camera's stack and turns it into 3136 numbers, the
# camera's *feature*. It is the same network for all cameras. Here are the three features as
# squares of 56 x 56, bright where a number is large. You cannot read them, but you can see that
# they differ, and that many numbers are zero: the last layer cuts off everything below zero.

# %%
feature_sheet(now)

# %%
source(Encoder)

# %%
names = [now.env.camera(camera).label for camera in policy.spec.streams]
table(["camera", "norm of its feature"], list(zip(names, now.probe.norms, strict=True)))

# %% [markdown]
# ## Play
#
# Press *Play*. Then switch *Third A* off, and on again; let it send black; let it freeze. Watch
# the first line of the table (what the policy does now) and how far every other set of cameras
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
tried = measure(policy, ["all"], episodes=3)["all"]
teaching.in_words(*tried)

# %% [markdown]
# Even three out of three leave a wide interval: a policy that works half the time has three
# successes in a row once in eight tries. The policy's card has 100 episodes, measured before and
# shipped with it:

# %%
teaching.in_words(*teaching.shipped("metaworld-hammer-mad-light")["all"])

# %% [markdown]
# ## Exercise
#
# Take the motion away: give the policy three copies of the newest picture, for all cameras. How
# much does its action change, compared with the change when one camera is dropped? A start:
#
#     import numpy as np
#     still = np.tile(now.stack[:, -3:], (1, 3, 1, 1))
#     encoded = policy.encode(still, now.state)
#
# `policy.read(encoded, np.array([[True, True, True]])).action` is the answer to the still
# pictures, and `now.action("first+third_b")` the one without Third A. A solution is in
# `solutions/01_three_cameras.py`.
