# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # 2. Merge
#
# **Question: how do the features of three cameras become one, so that the policy still works when
# a camera is missing?**
#
# In lesson 1 every camera was turned into a feature of 3136 numbers. The part of the network that
# decides (the *actor*) wants one feature, not three. MAD, the method of this project, adds them
# up:
#
# $$ M = \sum_{i \text{ present}} V_i $$
#
# Time: 30 minutes.

# %%
import numpy as np

import madviz
from madviz import teaching
from madviz.agent.merges.sum import merge_sum
from madviz.agent.networks import FEATURE_SIZE
from madviz.subsets import every_mask
from madviz.teaching.lessons import (
    answers,
    count_views,
    lengths_by_views,
    norm_bars,
    subset_table,
    untrained,
)
from madviz.teaching.show import source, table
from madviz.widgets import Explorer, Predict

teaching.begin()
policy = madviz.load_policy("metaworld-hammer-mad-light")
now = teaching.moment_at(policy, seed=2000, step=20)

# %% [markdown]
# ## The sum
#
# This is all of it, as it runs in training and on the live page. A *mask* says which cameras are
# there: a row of ones and zeros.

# %%
source(merge_sum)

# %% [markdown]
# With three cameras there are eight masks, from all of them to none:

# %%
every_mask(3).astype(int)

# %% [markdown]
# ## All subsets in one pass
#
# Every camera is encoded once. The eight sums cost next to nothing, and they go through the actor
# together as a batch of eight. So at every instant we know not only what the policy does, but
# also what it would do with every other set of cameras:

# %%
subset_table(now)

# %% [markdown]
# *Trained* says whether the policy learned to work from that set. *Q* is how much reward the
# policy expects from here on; where it was not trained, do not believe it (look at `none`). Pairs
# of cameras were never shown to it in training. They work all the same here, but nobody promised
# it.

# %% [markdown]
# ## How long is a sum?

# %%
guess = Predict(
    "A camera's feature has a certain length. How long is the sum of three, compared with one?",
    [
        "About the same",
        "Longer, and one can tell how many cameras there are",
        "Three times as long",
    ],
)
guess

# %%
norm_bars(now)

# %% [markdown]
# Features have no negative numbers (the encoder cuts them off), so they cannot cancel out: the
# more cameras, the longer the sum. It would be three times as long only if the three features
# pointed in the same direction.
#
# Can one tell the *number* of cameras from the length alone? Take the mean length for one, two
# and three cameras from one episode, and guess with them in two other episodes:

# %%
known = lengths_by_views(policy, seeds=[2000])
asked = lengths_by_views(policy, seeds=[2001, 2002])
hits, tries = count_views(known, asked)
measured = teaching.in_words(hits, tries)
print(measured)
guess.compare(f"the number of cameras is guessed from the length in {measured}")

# %% [markdown]
# Always saying "one" would be right for 3 of the 7 sets (three singles, three pairs, one triple),
# in 0.43. So the length tells something, but it does not tell all: in the saved run First
# person's feature is so long that it alone exceeds the sum of the two others. (The instants of
# one episode resemble each other; the interval treats every one as a new experiment, so the real
# one is wider.)
#
# This is the policy's difficulty in a nutshell: a sum over one camera looks different to the
# actor from a sum over three, merely because it is shorter. Lesson 3 shows what training does
# about it.

# %% [markdown]
# ## Why not put the features side by side?
#
# Three features side by side (*concatenation*) keep apart what came from where. But there is a
# place for every camera, and nothing to put into an empty one. Here is an untrained network of
# each kind; the numbers mean nothing, but what they accept does:

# %%
toy = teaching.moment_at(untrained("mad"), step=3)
subsets = ["all", "first", "first+third_b"]
answers(untrained("mad"), toy, subsets)

# %%
answers(untrained("concat"), toy, subsets)

# %% [markdown]
# And the next layer grows with the number of cameras, while with a sum it stays as it is:

# %%
views = [1, 2, 3, 5]
table(
    ["cameras", "numbers into the actor: sum", "side by side"],
    [[v, FEATURE_SIZE, v * FEATURE_SIZE] for v in views],
)

# %% [markdown]
# ## Play
#
# Step through an episode with single cameras. In which phase of the episode do the actions of
# different sets of cameras differ most: on the way to the hammer, or while hitting the nail?

# %%
explorer = Explorer(policy, seed=2001)
explorer

# %% [markdown]
# ## Exercise
#
# MAD adds features and does not average them. Suppose it did: divide the sum by the number of
# cameras. Can you still tell from the length how many cameras there are? Use `now.probe.features`
# (one row per camera) and `every_mask(3)`. What would be better about a mean, and what is lost
# with it? A solution is in `solutions/02_merge.py`.

# %%
print(now.probe.features.shape, np.linalg.norm(now.probe.features, axis=1).round(1))
