"""Success rates: episodes, statistics, comparison, and the store of results."""
