# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # 0. No install: a camera goes off
#
# **Question: two policies control the same robot and see it through the same three cameras. One
# camera fails. What do they do then, and why?**
#
# This lesson happens in a browser. The *site* is a folder of files: simulator, pictures, policies
# run in the browser that opens it, on a laptop, and nothing is installed. Your teacher
# has its address; `make site` builds one of your own and serves it at `http://127.0.0.1:8000`.
#
# The site has this lesson as a page, too: `lesson.html`, beside its first page. Who has a browser
# and nothing else does it there, with the same exercises. This notebook is for those who are in
# JupyterLab anyway, and for handing answers in.
#
# Time: 15 minutes.

# %%
from madviz import teaching
from madviz.teaching.lessons import interval_figure
from madviz.widgets import Predict, TryOut

teaching.begin()
SITE = "http://127.0.0.1:8000/"
MAD, MERGED_ONLY = "metaworld-hammer-mad-light", "metaworld-hammer-merged-only-light"

# %% [markdown]
# ## Predict first
#
# A *policy* is a function: it gets pictures, and answers with a movement. Both policies turn each
# picture into numbers (a *feature*), add up the features of all cameras, and act on the sum.

# %% tags=["prediction"]
guess = Predict(
    "Both were trained with three cameras. At step 15 the camera on the hand goes off.",
    ["Both fail", "Both go on", "One goes on, the other fails"],
)
guess

# %% [markdown]
# ## Look
#
# Open this link. Two robots have the same start, and the line above them says how both episodes
# end:

# %%
print(f"{SITE}#policy={MAD}&vs={MERGED_ONLY}&first=off@15")

# %%
guess.compare("MAD drives the nail in without First person, and Merged Only does not")

# %% [markdown]
# Then try, on the same page:
#
# 1. Switch *Third A* off instead of *First person*. Who fails now?
# 2. Switch it on again and press *break …*, then *black*. The camera now sends a black picture,
#    and its feature stays in the sum. Is that the same as *off*?
# 3. Press *Run 20* under one condition. Brackets are 95 % intervals: how far can you trust twenty
#    episodes? Put your count in here; the right bar is the same rate from ten times as many.

# %%
TryOut(interval_figure, successes=(0, 20, 1), n=(1, 20, 1))

# %% [markdown]
# One number in words, as the other lessons write it: Merged Only with all its cameras, measured
# before.

# %%
teaching.in_words(*teaching.shipped(MERGED_ONLY)["all"])

# %% [markdown]
# ## Exercise 1: read a rate
#
# Under *Success* the page shows what was measured over many episodes. How often do the two policies
# succeed **without First person**? The sets are named by the cameras that are left.

# %% tags=["answer"]
mad = ...
merged_only = ...

# %% tags=["solution"]
mad = 1.00
merged_only = 0.00

# %% tags=["check"]
teaching.check("00.rates", mad, merged_only)

# %% [markdown]
# ## Exercise 2: write a link
#
# The address of the page holds what is played. Write the part from `#` on which shows Merged Only
# with a Third A that sends **black from step 20 on**. Open it before you check it.

# %% tags=["answer"]
link = ""

# %% tags=["solution"]
link = f"#policy={MERGED_ONLY}&third_a=black@20"

# %% tags=["check"]
teaching.check("00.link", link)

# %% [markdown]
# ## Why
#
# <details>
# <summary>Open this once you have predicted and looked.</summary>
#
# Merged Only was trained on the sum of all three features and on nothing else. Nothing made it use
# every camera, and it came to depend on First person. MAD was also trained on each camera alone, so
# each feature must be enough to act on. Neither was trained on two cameras. MAD works there; Merged
# Only works while First person is in the sum. Lessons 1 to 3 show how this is done.
#
# </details>
