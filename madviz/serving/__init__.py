"""madviz's policies for other programs, in the protocols of ``madviz.wire``."""
