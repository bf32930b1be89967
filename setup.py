"""What pyproject.toml cannot say: README's relative links, where the package's index shows it."""

import re

from setuptools import setup
from setuptools.command.egg_info import egg_info


class AbsoluteLinks(egg_info):
    """Metadata whose description leads to the repository, or has no relative links."""

    def run(self):
        """Change the description, then write the metadata."""
        metadata = self.distribution.metadata
        address = dict(metadata.project_urls or {}).get("Repository")
        metadata.long_description = with_links(metadata.long_description, address)
        super().run()


def with_links(text, address):
    """Return Markdown with relative links made absolute; without an address only their text."""
    relative = r"(!?)\[([^\]]*)\]\((?!https?:)([^)]+)\)"

    def link(found):
        mark, label, path = found.groups()
        if address:
            kind = "raw" if mark else "blob"
            return f"{mark}[{label}]({re.sub(r'([.]git)?/?$', '', address)}/{kind}/main/{path})"
        return "" if mark else label

    return re.sub(relative, link, text)


setup(cmdclass={"egg_info": AbsoluteLinks})
