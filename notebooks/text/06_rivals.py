# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # 6. The rivals
#
# **Question: other methods handle several cameras in other ways. What does each of them do when a
# camera goes, and can you tell from its structure, before anything is trained?**
#
# Most networks of this lesson are *untrained*: their actions mean nothing. What they show is
# which sets of cameras they can answer to at all, and by which mechanism. One is trained for
# real.
#
# Time: 40 minutes.

# %%
import numpy as np
import torch

from madviz import teaching
from madviz.ablations import Occlusion
from madviz.agent.bottleneck import kl_loss
from madviz.agent.contrast import drawn
from madviz.agent.merge import stacked_pixels
from madviz.subsets import mask_of
from madviz.teaching_lessons import answers, measure, support_table, untrained
from madviz.teaching_show import source
from madviz.widgets import Explorer, Predict

teaching.begin()
SUBSETS = ["all", "first", "third_a", "first+third_b"]

# %% [markdown]
# ## Before you look
#
# | method | idea in one sentence |
# |---|---|
# | Single Camera | one camera from the start |
# | frame-stack | the pixels of all cameras in one picture with many channels |
# | concat | one feature per camera, side by side |
# | attention, ViT | features look at each other, then are merged |
# | Q-mean | every camera acts and judges for itself, and the answers are averaged |
# | MVD | a part that all cameras share beside a part of one camera's own |
# | VIB | everything but the first camera must pass a noisy bottleneck |
# | MAD | features are summed, and each term learns to stand alone |

# %%
guess = Predict(
    "How many of these can answer at all when one of three cameras is missing?",
    ["All of them", "All but two", "All but three, and Single Camera if it is the wrong one"],
)
guess

# %%
support_table()

# %%
guess.compare("frame-stack and concat need all; VIB has no rule for two of three; Single has one")

# %% [markdown]
# That a method *can* answer does not mean that the answer is good. Merged Only (lesson 3) answers
# to every set, and fails with most.

# %% [markdown]
# ## Frame stack: a place for every pixel
#
# All pixels go into one network. The camera's place in the stack is fixed, and an empty place
# cannot be expressed:

# %%
source(stacked_pixels)

# %%
stacked = untrained("frame-stack")
moment = teaching.moment_at(untrained("mad"), step=3)
answers(stacked, moment, SUBSETS)

# %% [markdown]
# People then send black pictures for the missing camera. Lesson 4 showed what that is: an input
# nobody trained on.
#
# ## Q-mean, attention: any set, because each view comes in one by one

# %%
answers(untrained("q-mean"), moment, SUBSETS)

# %%
answers(untrained("attention"), moment, SUBSETS)

# %% [markdown]
# Both accept every set with one camera or more. But in training they see all cameras together, so
# nothing teaches them to do without.
#
# ## MVD: two cameras at most
#
# MVD has two encoders: one for what *any* camera would tell, one for what *this* camera alone
# tells. A policy acts on the shared part of one camera, drawn at random, beside the private part
# of another. So it meets single cameras in training, but it never sees more than two at once:

# %%
source(drawn)

# %%
mvd = untrained("mvd")
answers(mvd, moment, SUBSETS)

# %% [markdown]
# Which camera is drawn depends on chance. For one instant, look at many draws: how often is the
# shared part that of the first camera, when all three are there? It should be one third.

# %%
draws = torch.rand(600, 2, 3, generator=torch.Generator().manual_seed(0))
everything = torch.from_numpy(mask_of("all", mvd.spec.streams))[None]
first = sum(int(drawn(everything, keys)[0, 0]) == 0 for keys in draws)
teaching.in_words(first, len(draws))

# %% [markdown]
# ## VIB: what a third-person camera adds must be worth its bits
#
# The first-person camera goes through as it is. Each other one becomes a cloud (a Gaussian), of
# which a sample goes on; a cloud that differs from the standard one costs something. So in doubt
# VIB says less about the third-person cameras, which is good where they do not matter, and bad
# where the first camera is the one that goes.

# %%
source(kl_loss)

# %%
answers(untrained("vib"), moment, SUBSETS)

# %% [markdown]
# ## Single Camera: trained for real
#
# The yardstick: a policy that had one camera from the start, here Third A on `toy/reach`. It
# trains in about a minute.

# %%
single = teaching.train_small("single", camera="third_a", rounds=5, updates=80)
print(f"\n{single.seconds:.0f} s")

# %%
guess_single = Predict(
    "Its only camera sends black from the first step on. How often does it reach the target?",
    ["Never", "Now and then, by chance", "About half of the time"],
)
guess_single

# %%
works = measure(single.policy, ["all"], 40)["all"]
blind = measure(single.policy, ["all"], 40, occlusions={"third_a": Occlusion("black")})["all"]
print("Third A works:", teaching.in_words(*works))
guess_single.compare(teaching.in_words(*blind))

# %% [markdown]
# A single camera has nothing to lose but everything. The paper's argument for several cameras is
# not only that they see more, but that no single one of them is needed.
#
# ## Play

# %%
explorer = Explorer(single.policy, seed=2001)
explorer

# %% [markdown]
# ## What this lesson does not show
#
# How well MVD, VIB and the other merges *learn* on robots was not measured here; their trainings
# take much longer than a lesson. What you saw is the structure: which questions a method can
# answer at all.
#
# ## Exercise
#
# Give the untrained `concat` policy all three cameras with Third A black, as people do. Then
# compare: how far does its action move, and how far does that of untrained `mad` move when Third
# A is (a) black and (b) dropped? Why can MAD choose, and concat not? Start with
# `moment.stack.copy()`, and set row 1 to zero. A solution is in `solutions/06_rivals.py`.

# %%
print(np.shape(moment.stack))
explorer.close()
