"""Results → one self-contained HTML file, for people who judge rewards by eye.

`sections` lists the kinds of section, `content` their items; `charts` draws items as SVG, and `html` fills the
templates. Each kind of result has a module that builds its page: `comparison_page`, `inspection_page`, `sub_goal_page`.
"""
