"""Divide every dataset of more than one recording into pages, in each process of `make test-paged`."""

from __future__ import annotations

from tacpipe.datasets import pages

pages.INLINE = 1
