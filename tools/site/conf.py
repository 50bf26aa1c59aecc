"""Sphinx's configuration of the site (https://www.sphinx-doc.org/en/master/usage/configuration.html)."""

import dart_flight

project = "DART flight"
version = release = dart_flight.__version__
html_title = f"DART flight {version}"

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "tools.site.extension"]

myst_heading_anchors = 4  # as checkouts show them, so that a link to a heading works in both
myst_fence_as_directive = ["math", "mermaid"]
highlight_language = "none"

autodoc_typehints = "signature"
autodoc_member_order = "bysource"
maximum_signature_line_length = 90
napoleon_use_ivar = True
napoleon_use_rtype = False
python_use_unqualified_type_names = True
add_module_names = False

html_theme = "furo"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_js_files = ["site.js"]
html_math_renderer = "mathml"
html_copy_source = False
html_show_sourcelink = False
html_show_copyright = False
html_theme_options: dict[str, list[str]] = {"top_of_page_buttons": []}
html_use_index = False
pygments_style, pygments_dark_style = "friendly", "monokai"
