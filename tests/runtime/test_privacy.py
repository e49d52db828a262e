from __future__ import annotations

import pytest

from zest_rl.runtime.privacy import masked


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("--goal=/home/me/my goals/door", "--goal=…/door"),
        ("timm:resnet18@/home/me/x.pth", "timm:resnet18@…/x.pth"),
        ("command:/usr/bin/python3 /home/me/serve.py --password=a", "command:…/python3 …/serve.py --password=…"),
        ('{"model": "/home/me/x.xml"}', '{"model": "…/x.xml"}'),
        ('{"model":"/home/my self/x.xml", "password": "a"}', '{"model": "…/x.xml", "password": "…"}'),
        ('{"model":"x.xml"}', '{"model":"x.xml"}'),
        ("--api-key abc --n 5", "--api-key … --n 5"),
        ("WANDB_API_KEY=abc", "WANDB_API_KEY=…"),
        ("https://me:pw@host.org/x", "https://…@host.org/x"),
        ("hf_abcdefghijklmnop", "…"),
        ("zest/kitchen-micro-v0", "zest/kitchen-micro-v0"),
        ("text:door open and/or ajar", "text:door open and/or ajar"),
        ("--tokens=5", "--tokens=5"),
        ("https://host.org/x/y", "https://host.org/x/y"),
    ],
)
def test_folders_and_secrets_are_left_out_of_what_is_published(text: str, expected: str) -> None:
    assert masked(text) == expected
    assert masked(expected) == expected


def test_the_words_of_a_command_hide_what_follows_a_secret_flag() -> None:
    words = ["/usr/bin/env", "--password", "hunter2", "/home/me/w.pt", "--auth"]
    assert masked(words) == ["…/env", "--password", "…", "…/w.pt", "--auth"]
    assert masked({"files": {"/home/me/w.pt": "12ab"}, "n": 3}) == {"files": {"…/w.pt": "12ab"}, "n": 3}


def test_files_of_one_name_in_several_folders_stay_several_and_what_a_secret_s_name_stands_for_is_hidden() -> None:
    assert masked({"/a/w.pt": "1", "/b/w.pt": "2", "/c/w.pt": "3"}) == {
        "…/w.pt": "1", "…/w.pt (2)": "2", "…/w.pt (3)": "3",
    }  # fmt: skip
    assert masked({"password": "x", "API_KEY": ["y"], "n_tokens": 5}) == {
        "password": "…",
        "API_KEY": "…",
        "n_tokens": 5,
    }
