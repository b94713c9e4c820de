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
# decides (the *actor*) wants one feature, not three. MAD, the method that this project implements,
# adds them up:
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
from madviz.subsets import every_mask, name_of
from madviz.teaching.lessons import answers, untrained
from madviz.teaching.show import bars, source, table
from madviz.widgets import Explorer, Predict

teaching.begin()
policy = madviz.load_policy("metaworld-hammer-mad-light")
now = teaching.moment_at(policy, seed=2000, step=20)

# %% [markdown]
# ## The sum
#
# This is all of it, as it runs in training and on the live page. A *mask* says which cameras are
# present: a row of ones and zeros.

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
# together as a batch of eight. So at every time step we know not only what the policy does, but
# also what it would do with every other subset of cameras:

# %%
masks = every_mask(3)
names = [name_of(mask, policy.spec.streams) for mask in masks]
encoded = policy.encode(now.stack, now.state)
read = policy.read(encoded, masks)
norms = np.linalg.norm(read.merged, axis=1)
trained = [name in policy.spec.trained_subsets for name in names]
actions = [" ".join(f"{a:+.2f}" for a in action) for action in read.action]
columns = zip(map(teaching.named, names), trained, norms, actions, read.q, strict=True)
table(["cameras", "trained", "norm of M", "action", "Q"], list(columns))

# %% [markdown]
# *Trained* says whether the policy learned to work from that set. *Q* is how much reward the
# policy expects from here on; for subsets it was not trained on, do not trust it (see `none`).
# Pairs of cameras were never used in its training. They work all the same here, but there was no
# guarantee.

# %% [markdown]
# ## The norm of a sum

# %% tags=["prediction"]
guess = Predict(
    "How large is the norm of the sum of three features, compared with that of one?",
    [
        "About the same",
        "Larger, and one can infer how many cameras there are",
        "Three times as large",
    ],
)
guess

# %%
bars(
    "norm of M, largest = 1",
    [*map(teaching.named, names)],
    {"this time step": list(norms / norms.max())},
)

# %% [markdown]
# Features have no negative numbers (the encoder cuts them off), so they cannot cancel out: the
# more cameras, the larger the norm of the sum. It would be three times as large only if the three
# features pointed in the same direction.
#
# Can one infer the *number* of cameras from the norm alone? Take the mean norm for one, two and
# three cameras from one episode, and guess with them in two other episodes:

# %%
views = masks[:-1].sum(1)  # Of every set but the empty one: 3 2 2 1 2 1 1.


def norms_of(seed):
    """One row per time step, one column per set; every fifth time step of an episode."""
    chosen = [moment for moment in teaching.moments(policy, seed) if moment.step % 5 == 0]
    return np.array([np.linalg.norm(m.probe.readout.merged[:-1], axis=1) for m in chosen])


# %%
known, asked = norms_of(2000), np.concatenate([norms_of(2001), norms_of(2002)])
means = np.array([known[:, views == number].mean() for number in (1, 2, 3)])
guessed = 1 + np.abs(asked[..., None] - means).argmin(-1)
hits, tries = int((guessed == views).sum()), guessed.size
measured = teaching.in_words(hits, tries)
print(measured)
guess.compare(f"the number of cameras is guessed from the norm in {measured}")

# %% [markdown]
# Always saying "one" would be right for 3 of the 7 sets (three singles, three pairs, one triple),
# in 0.43. So the norm says something, but not everything: in the saved run the norm of First
# person's feature is larger than that of the sum of the two others. (The time steps of one
# episode resemble each other; the interval treats every one as a new experiment, so the real one
# is wider.)
#
# This is the policy's difficulty: to the actor, a sum over one camera differs from a sum over
# three, merely because its norm is smaller. Lesson 3 shows what training does about it.

# %% [markdown]
# ## Why not put the features side by side?
#
# Three features side by side (*concatenation*) show which camera each number came from. But every
# camera has its place, and there is nothing to put there when it is missing. Here is an untrained
# network of each kind; the numbers mean nothing, but what they accept does:

# %%
toy = teaching.moment_at(untrained("mad"), step=3)
subsets = ["all", "first", "first+third_b"]
answers(untrained("mad"), toy, subsets)

# %%
answers(untrained("concat"), toy, subsets)

# %% [markdown]
# And the next layer grows with the number of cameras, while with a sum it stays as it is:

# %%
counts = [1, 2, 3, 5]
table(
    ["cameras", "numbers into the actor: sum", "side by side"],
    [[count, FEATURE_SIZE, count * FEATURE_SIZE] for count in counts],
)

# %% [markdown]
# ## Play
#
# Step through an episode with single cameras. In which phase of the episode do the actions of
# different subsets of cameras differ most: on the way to the hammer, or while hitting the nail?

# %%
explorer = Explorer(policy, seed=2001)
explorer

# %% [markdown]
# ## Exercise 1: a sum of your own
#
# Write `merge` for one time step, with NumPy. `features` has one row per camera, as
# `now.probe.features` has, and `present` says which cameras are there: `[True, False, True]` is a
# row of `every_mask(3)`. With no camera present the result is a zero for each number.


# %% tags=["answer"]
def merge(features, present):
    return ...


# %% tags=["solution"]
def merge(features, present):
    return features[present].sum(0)


# %% tags=["check"]
teaching.check("02.merge", merge)

# %% [markdown]
# ## Exercise 2: a mean in place of the sum
#
# MAD adds features and does not average them. Suppose it did: write `mean` over the cameras that
# are present, and zeros where there is none. Then ask your function what the norm says: is it
# still larger with more cameras? What would be better about a mean, and what is lost with it?


# %% tags=["answer"]
def mean(features, present):
    return ...


# %% tags=["solution"]
def mean(features, present):
    return features[present].sum(0) / max(present.sum(), 1)


# %% tags=["check"]
teaching.check("02.mean", mean)

# %% tags=["solution"]
rows = [
    [teaching.named(name_of(mask, policy.spec.streams))]
    + [float(np.linalg.norm(merged(now.probe.features, mask))) for merged in (merge, mean)]
    for mask in every_mask(3)
]
table(["cameras", "norm of the sum", "norm of the mean"], rows)

# %% [markdown] tags=["solution"]
# A mean does not make the norms alike: it reverses their order. Three features that point in
# different directions shrink when they are averaged, so now the single cameras have large norms
# and all together a small one. The norm still depends on the number of cameras. And something is
# lost: with a mean, a camera counts for a third as soon as two others join. With a sum, it adds
# the same term in every subset, alone or beside others.
