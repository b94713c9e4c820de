"""``python -m madviz``, the same as the console script."""

from madviz.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
