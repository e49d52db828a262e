"""Results → one self-contained HTML file, for people who choose a reward by looking.

`sections` lists what a page may hold and `content` what that is made of; `charts` draws it as SVG, and `html` puts it
into the templates. One module per kind of result builds its page: `comparison_page`, `inspection_page`,
`sub_goal_page`.
"""
