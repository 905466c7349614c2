"""Fill in what the metadata of a wheel cannot say in a clone: addresses of the repository that it was built from.

`JAWUSD_REPOSITORY_URL` (https://host/owner/jawusd) and `JAWUSD_DOCS_URL` are set by the workflow of releases. With the
first one the readme's pictures and links are made absolute, so that the page of a package index shows them; without,
they stay as they are, and the metadata names no addresses.
"""

import os
import re
from pathlib import Path

from hatchling.metadata.plugin.interface import MetadataHookInterface

_LINK = re.compile(r"(!?)\[([^\]]*)\]\((?!https?://|#)([^)\s]+)\)")


class AddressHook(MetadataHookInterface):
    """Add readme and URLs."""

    def update(self, metadata):
        """Set both in the metadata."""
        text = (Path(self.root) / "README.md").read_text(encoding="utf-8")
        repository = os.environ.get("JAWUSD_REPOSITORY_URL", "").rstrip("/")
        docs = os.environ.get("JAWUSD_DOCS_URL", "").rstrip("/")
        if repository:
            text = absolute(text, repository, f"v{metadata['version']}")
            metadata["urls"] = {
                "Repository": repository,
                "Changelog": f"{repository}/blob/main/CHANGELOG.md",
                "Issues": f"{repository}/issues",
                **({"Documentation": docs} if docs else {}),
            }
        metadata["readme"] = {"content-type": "text/markdown", "text": text}


def absolute(text, repository, tag):
    """Return Markdown whose local links and pictures lead to files of a repository at a tag."""

    def changed(found):
        kind = "raw" if found[1] else "blob"
        return f"{found[1]}[{found[2]}]({repository}/{kind}/{tag}/{found[3]})"

    return _LINK.sub(changed, text)
