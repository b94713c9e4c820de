# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # 8. The live page, in the notebook
#
# **Question: what do ten minutes with the live page show you that the card of a policy does
# not?**
#
# `madviz explore` serves a page for a browser. Here it is shown in the notebook. If your browser
# and the notebook's kernel are on different machines (a class server, for example), the page is
# passed on by the notebook's own server, and its address then ends in `/proxy/PORT/`. The slash
# at the end matters.
#
# Time: 30 minutes.

# %%
from madviz import teaching
from madviz.teaching.lessons import interval_figure
from madviz.teaching.show import table
from madviz.widgets import Predict, TryOut, live_page

teaching.begin()
POLICY = "metaworld-hammer-merged-only-light"

# %%
guess = Predict(
    "The policy merged-only has three cameras. Without which one does it do worst?",
    ["First person", "Third A", "Third B"],
)
guess

# %% [markdown]
# The next cell starts the page in the background; it takes some seconds until the first picture
# is there. In a saved notebook you see an empty frame instead: there is no server behind it.

# %%
page = live_page(POLICY)
page

# %% [markdown]
# Take the cameras away one at a time, from the start of an episode to its end, and keep a tally:
# how many episodes, how many successes? At *full speed* an episode takes a few seconds. Then put
# your numbers here:

# %%
TryOut(interval_figure, successes=(0, 20, 1), n=(1, 20, 1))

# %% [markdown]
# The card's numbers, from 100 episodes each (shipped):

# %%
shipped = teaching.shipped(POLICY)
pairs = ["third_a+third_b", "first+third_b", "first+third_a"]
table(
    ["without", "success"],
    [
        [camera, teaching.in_words(*shipped[subset])]
        for camera, subset in zip(["First person", "Third A", "Third B"], pairs, strict=True)
    ],
)

# %%
worst = min(
    zip(pairs, ["First person", "Third A", "Third B"], strict=True), key=lambda p: shipped[p[0]]
)
guess.compare(f"without {worst[1]}")

# %% [markdown]
# ## What only the page shows
#
# The card counts episodes in which a camera is missing *from the first step*. On the page you can
# take it away in the middle. When does it hurt least? Try it: drop First person before the hand
# has the hammer, and after.
#
# The same page in a window of its own (on this machine): open the address below.

# %%
page.direct

# %% [markdown]
# ## Exercise
#
# Write down a sentence of the form "merged-only needs First person until ..., and then no more",
# and test it with ten episodes. What would you need to be sure? A solution with a measurement in
# code is in `solutions/08_live_page.py`.
#
# The page ends with this notebook's kernel, and sooner with `page.close()`.
