# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # 7. How methods merge
#
# **Question: lesson 6 showed which methods work without a camera. How are they built, and how does
# that explain it?**
#
# Here you see each of them on *untrained* networks: their actions mean nothing, but what they do
# about a missing camera is the same before and after training.
#
# Time: 35 minutes. Lessons 2 and 6 come before this one.

# %%
import numpy as np
import torch

from madviz import teaching
from madviz.agent.merges.concat import concatenated
from madviz.agent.merges.frame_stack import stacked_pixels
from madviz.agent.merges.mvd import drawn
from madviz.agent.merges.q_mean import mean_of_present
from madviz.agent.merges.vib import kl_loss
from madviz.teaching.lessons import answers, untrained
from madviz.teaching.merges import attention_shares
from madviz.teaching.show import source
from madviz.widgets import Explorer, Predict

teaching.begin()
SUBSETS = ["all", "first", "third_a", "first+third_b"]
moment = teaching.moment_at(untrained("mad"), step=3)

# %% [markdown]
# ## A place for every camera: frame-stack and concat
#
# Frame-stack puts all pixels into one network, concat puts all features side by side. Either way
# a camera has its fixed place, and there is nothing to put there when it is missing:

# %%
source(stacked_pixels, concatenated)

# %%
answers(untrained("concat"), moment, SUBSETS)

# %% [markdown]
# So people send a black picture for a missing camera. How far does the action move then? For MAD,
# there is a choice: Third A can send black, or be dropped.

# %%
mad, concat = untrained("mad"), untrained("concat")
everything, without = np.array([[True, True, True]]), np.array([[True, False, True]])
black = moment.stack.copy()
black[1] = 0
for name, policy, stack, mask in (
    ("concat, Third A black", concat, black, everything),
    ("mad, Third A black   ", mad, black, everything),
    ("mad, Third A dropped ", mad, moment.stack, without),
):
    before = policy.read(policy.encode(moment.stack, moment.state), everything).action[0]
    after = policy.read(policy.encode(stack, moment.state), mask).action[0]
    print(name, f"{np.linalg.norm(after - before):.2f}")

# %% [markdown]
# The numbers of untrained networks mean nothing by themselves. The point is the third line: it
# exists for MAD and not for concat. A sum without a term is still a sum; features side by side with
# one of them missing are not what the network expects.
#
# ## Each view for itself: q-mean
#
# Every present camera gives an action of its own, and the actions are averaged (before they are
# squashed into -1 to 1). If one is missing, the mean is taken over fewer:

# %%
source(mean_of_present)

# %%
q_mean = untrained("q-mean")
encoded = q_mean.encode(moment.stack, moment.state)
alone = q_mean.read(encoded, np.eye(3, dtype=bool)).action
together = q_mean.read(encoded, np.ones((1, 3), bool)).action[0]
print("one camera each:  ", *alone.round(2))
print("mean before tanh: ", np.tanh(np.arctanh(alone).mean(0)).round(2))
print("all:              ", together.round(2))

# %% [markdown]
# ## Views that attend to each other: attention and ViT
#
# Every view sends a query, and the others answer; the shares say how much each answer counts. A
# dropped camera is never attended to. Its share goes to those that are left, so the sum of the
# shares stays 1. Here are the shares with all cameras, and without Third A:

# %%
attention_shares(untrained("vit"), moment, "all")

# %%
attention_shares(untrained("vit"), moment, "first+third_b")

# %% [markdown]
# `attention` is the same, except that a view attends to the other views only, and in the end all
# are summed. Without Third A the two that are left attend to each other. With one camera left there
# is no other view, and its feature is used as it is.

# %%
attention_shares(untrained("attention"), moment, "first+third_b")

# %% [markdown]
# q-mean, attention and ViT accept every subset with one camera or more. But in training they have
# all cameras together, so nothing teaches them to do without one.
#
# ## MVD: two cameras at most
#
# MVD has two encoders: one for what *any* camera shows, one for what *this* camera alone shows.
# A policy acts on the shared part of one camera, drawn at random, beside the private part of
# another, and often both draws give the same camera. So it is trained on single cameras, but never
# on more than two at once:

# %%
source(drawn)

# %% [markdown]
# Only present cameras are drawn. If the missing one would not have been drawn, nothing changes at
# all.

# %% tags=["prediction"]
guess = Predict(
    "Third A is missing. How often does that change nothing at all?",
    ["in 1/3 of all draws", "in 4/9 of all draws", "in 2/3 of all draws"],
)
guess

# %% [markdown]
# Count it, in 600 draws. Two draws must both be of another camera, so it should be 2/3 times 2/3:

# %%
generator = torch.Generator().manual_seed(0)
keys = torch.rand(600, 2, 3, generator=generator)
masks = torch.tensor([[True, True, True], [True, False, True]])
pairs = torch.stack([drawn(masks, key) for key in keys])  # Time, part, set: which camera.
same = (pairs[..., 0] == pairs[..., 1]).all(1).sum()
guess.compare(teaching.in_words(int(same), 600))

# %% [markdown]
# ## VIB: information from a third-person camera has a price
#
# The feature of the first-person camera is used as it is. Each other one becomes a Gaussian
# distribution, of which a sample is used; the more it differs from the standard normal one, the
# larger the loss. So in doubt VIB uses less of the third-person cameras, which is good where they
# do not matter, and bad where the first-person camera is the missing one.

# %%
source(kl_loss)

# %% [markdown]
# When one camera is left, its picture is put into all three places, as in the code of MAD's paper.
# For two of three there is no rule, so this package refuses them:

# %%
vib = untrained("vib")
third_a = np.array([[False, True, False]])
alone = vib.read(vib.encode(moment.stack, moment.state), third_a).action[0]
thrice = vib.encode(moment.stack[[1, 1, 1]], moment.state)
everywhere = vib.read(thrice, np.ones((1, 3), bool)).action[0]
print("only Third A:        ", alone.round(2))
print("three times Third A: ", everywhere.round(2))

# %%
answers(vib, moment, SUBSETS)

# %% [markdown]
# ## Play
#
# An untrained MAD moves somehow, with every subset. Put `concat`, `vib` or another method
# in its place, and switch a camera off: which of them go on, and what do the others say?

# %%
explorer = Explorer(untrained("mad"), seed=2001)
explorer

# %% [markdown]
# ## Exercise 1: Q-mean's action
#
# Write it for one time step. `actions` has a row for each camera, the action on that camera alone,
# between -1 and 1; `present` says which cameras are there, and at least one is.


# %% tags=["answer"]
def mean_action(actions, present):
    return ...


# %% tags=["solution"]
def mean_action(actions, present):
    return np.tanh(np.arctanh(actions[present]).mean(0))


# %% tags=["check"]
teaching.check("07.mean_action", mean_action)

# %% [markdown]
# ## Exercise 2: shares of attention
#
# A query has been compared with the key of every camera: `scores` has a number for each. Softmax
# makes shares of them, $e^{s_i} / \sum_j e^{s_j}$. Write `shares`, where a camera that is not
# present has none.


# %% tags=["answer"]
def shares(scores, present):
    return ...


# %% tags=["solution"]
def shares(scores, present):
    weights = np.exp(scores) * present
    return weights / weights.sum()


# %% tags=["check"]
teaching.check("07.shares", shares)

# %% [markdown]
# With your function, and three scores: what happens to the shares of the others when Third A is
# dropped? And to their sum, had it been a sum of features as in MAD?

# %%
scores = np.array([1.0, 2.0, 0.5])
print(shares(scores, np.array([True, True, True])).round(2))
print(shares(scores, np.array([True, False, True])).round(2))

# %% [markdown] tags=["solution"]
# The shares of the others grow, and still add up to 1: what comes out is a mean, of the same size
# with two cameras as with three. In a sum the others stay what they are, and the sum gets smaller.
