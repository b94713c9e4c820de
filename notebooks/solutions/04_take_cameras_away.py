# %% [markdown]
# # Solution 4: nine of ten against seven of ten

# %%
from madviz.evaluation.statistics import Paired
from madviz.teaching.show import table

best = Paired(both=7, first_only=2, second_only=0, neither=1)
worst = Paired(both=6, first_only=3, second_only=1, neither=0)
more = Paired(both=70, first_only=20, second_only=0, neither=10)
more_mixed = Paired(both=60, first_only=30, second_only=10, neither=0)
rows = [
    [name, one.n, one.difference, f"[{one.interval()[0]:+.2f}, {one.interval()[1]:+.2f}]"]
    + [f"{one.mcnemar():.2g}"]
    for name, one in {
        "ten episodes, best case for A": best,
        "ten episodes, worst case for A": worst,
        "a hundred episodes, best case": more,
        "a hundred episodes, worst case": more_mixed,
    }.items()
]
table(["case", "n", "A - B", "95% interval", "exact p"], rows)

# %% [markdown]
# With ten episodes neither case says that A is better: two tosses that both come up heads are no
# evidence. With a hundred both do. The case in which the episodes agree is the stronger one: only
# those with different outcomes count, and there all of them are for A.
