"""The words of madviz, each with one sentence."""
