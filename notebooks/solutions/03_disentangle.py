# %% [markdown]
# # Solution 3: Singular Only
#
# It never saw a sum, and a sum is longer than anything it knows. It works from single cameras. On
# all three its actions come from inputs it never met: sometimes that goes well, but nobody
# trained it to.

# %%
from madviz import teaching
from madviz.teaching.lessons import measure

teaching.begin()
singular = teaching.train_small("singular-only", rounds=6, updates=100)
measured = measure(singular.policy, ["all", "first", "third_a", "third_b"], 40)
teaching.success_table({"singular-only": measured})

# %% [markdown]
# Compare the row `all` with MAD's in the lesson, and mind the intervals: 40 episodes tell 0.9
# from 0.5, but not from 0.8.
