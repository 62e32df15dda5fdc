"""Metadata of a distribution that depend on where its source is published.

Where SOURCE_URL is set (the address of the repository) the links of the README are absolute, as an
index of packages needs them, at the version that SOURCE_VERSION names; its line that clones the
repository has the address; and the metadata have the project's addresses. The release workflow sets
both. Elsewhere the README is as it is.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface

_LINK = re.compile(r"(!?)(\[[^\]]*\])\((?!\w+:|#)([^)]+)\)")


def absolute(text: str, source: str, version: str) -> str:
    """Make the relative links and images of a Markdown text absolute."""

    def linked(match: re.Match[str]) -> str:
        kind = "raw" if match[1] else "blob"
        return f"{match[1]}{match[2]}({source}/{kind}/{version}/{match[3]})"

    return _LINK.sub(linked, text)


class PublishedMetadata(MetadataHookInterface):
    """Readme and addresses of the project."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Fill in the fields that pyproject.toml calls dynamic."""
        text = Path(self.root, "README.md").read_text(encoding="utf-8")
        source = os.environ.get("SOURCE_URL", "").rstrip("/")
        version = os.environ.get("SOURCE_VERSION", "main")
        if source:
            text = absolute(text, source, version).replace("SOURCE_URL", source)
            metadata["urls"] = {
                "Source": source,
                "Documentation": f"{source}/tree/{version}/docs",
                "Changelog": f"{source}/blob/{version}/CHANGELOG.md",
                "Issues": f"{source}/issues",
            }
        metadata["readme"] = {"content-type": "text/markdown", "text": text}
