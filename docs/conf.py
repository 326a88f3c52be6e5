"""Sphinx configuration of the site.

Build it with `sphinx-build -W --keep-going docs docs/_build/html`. It needs the extra `docs` and
no network; nothing that it shows loads from elsewhere.
"""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE / "_ext"), str(HERE.parent)]
# The kernels of the executed pages are local; their notes about encryption would fill the log.
settings = tempfile.TemporaryDirectory()  # removed at the end
profile = Path(settings.name) / "profile_default"
profile.mkdir()
(profile / "ipython_kernel_config.py").write_text("c.IPKernelApp.log_level = 40\n")
os.environ["IPYTHONDIR"] = str(profile.parent)
os.environ["PYTHONPATH"] = os.pathsep.join([str(HERE.parent), os.environ.get("PYTHONPATH", "")])

from mor_bench.version import __version__  # noqa: E402

project = "mor-bench"
author = copyright = "The mor-bench authors"
version = release = __version__

extensions = [
    "myst_nb",
    "numpydoc",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.mathjax",
    "sphinx.ext.viewcode",
    "sphinx-mathjax-offline",
    "sphinx_design",
    "sphinx_gallery.gen_gallery",
    "sphinxcontrib.bibtex",
    "repository_links",
    "method_cards",
    "order_plots",
    "performance_history",
]
exclude_patterns = [
    "_build",
    "_ext",
    "cards",
    "examples",
    *(f"gallery/*.{end}" for end in ("ipynb", "json", "md5", "py", "zip")),
]
language = "en-GB"
nitpicky = False

myst_enable_extensions = ["amsmath", "colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3
nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_timeout = 180

autosummary_generate = True
autodoc_typehints = "none"
autodoc_default_options = {"members": True, "inherited-members": False}
numpydoc_show_class_members = False
numpydoc_xref_param_type = False

bibtex_bibfiles = ["references.bib"]

sphinx_gallery_conf = {
    "examples_dirs": ["examples"],
    "gallery_dirs": ["gallery"],
    "filename_pattern": r"\.py$",
    "run_stale_examples": True,  # their pictures depend on the stored runs, too
    "copyfile_regex": r".*\.toml",
    "download_all_examples": False,
    "show_memory": False,
    "abort_on_example_error": True,
    "min_reported_time": 1e9,
    "write_computation_times": False,  # the page of times would load scripts from elsewhere
    "image_scrapers": ("matplotlib",),
    "remove_config_comments": True,
}

html_theme = "pydata_sphinx_theme"
html_title = "mor-bench"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_js_files = ["site.js"]
html_show_sourcelink = False
html_copy_source = False
html_show_search_summary = False  # summaries are fetched, which browsers refuse in local files
html_theme_options = {
    "navbar_align": "left",
    "header_links_before_dropdown": 6,
    "navbar_end": ["theme-switcher"],
    "show_toc_level": 2,
    "secondary_sidebar_items": ["page-toc"],
    "footer_start": ["copyright"],
    "footer_end": [],
    "navigation_with_keys": False,
}
html_context = {"default_mode": "auto"}
WITH_MEMBERS = {"api", "methods", "gallery"}
html_sidebars = {page.stem: [] for page in HERE.glob("*.md") if page.stem not in WITH_MEMBERS}


def _is_of_scikit_learn(app, what, name, member, skip, options):
    """Leave out methods that scikit-learn adds, whose texts refer to its own site."""
    return True if name == "get_metadata_routing" or name.endswith("_request") else None


def setup(app):
    """Register the events."""
    app.connect("autodoc-skip-member", _is_of_scikit_learn)
