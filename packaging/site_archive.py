"""Build the documentation site of a version, and pack it as an archive that is read offline."""

from __future__ import annotations

import shutil
import zipfile
from pathlib import Path

from wheels import ROOT, run

__all__ = ["build_site", "pack_site"]


def build_site(version: str, work: Path) -> Path:
    """Build the site as `make docs` does, but into an empty folder, so that no old page is left.

    Args:
        version: for the titles of the pages.
        work: folder for the site. Pages that were read, and notebooks that were executed, are kept
            where `make docs` keeps them.
    Returns:
        The folder of the site.
    """
    site = work / "site"
    shutil.rmtree(site, ignore_errors=True)
    # The version of .venv is that of the last set-up, which may be older than the tag.
    titles = {"version": version, "release": version, "html_title": f"haselab {version}"}
    settings = [word for name, value in titles.items() for word in ("-D", f"{name}={value}")]
    python = ROOT / ".venv/bin/python"
    run([python, "-m", "sphinx", "-q", "-W", "--keep-going", "-n", "-c", ROOT / "docs",
         *settings, "-d", ROOT / "out/doctrees", ROOT, site])  # fmt: skip
    return site


def pack_site(site: Path, version: str, out: Path) -> Path:
    """Write `haselab-VERSION-docs.zip`, whose top folder has the same name.

    Args:
        site: folder of the built site.
        version: of the packages.
        out: folder for the archive.
    Returns:
        The archive.
    """
    archive = out / f"haselab-{version}-docs.zip"
    out.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as opened:
        for path in sorted(site.rglob("*")):
            name = path.relative_to(site)
            if path.is_file() and not any(part.startswith(".") for part in name.parts):
                opened.write(path, f"{archive.stem}/{name.as_posix()}")
    return archive
