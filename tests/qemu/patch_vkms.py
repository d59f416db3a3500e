"""Lets vkms take an EDID and gives its connectors what real ones have: patch_vkms.py VKMS_CONNECTOR_C.

The kernel's file is changed in place. Where it is not as expected, for example in another kernel, nothing is written.
"""

import sys
from pathlib import Path

# What is added behind a line, which must be there once.
ADDITIONS = {
    # In the function that lists a connector's modes: those of an EDID that was put there from outside come first.
    "\tint count;\n": """
\tcount = drm_edid_override_connector_update(connector);
\tif (count)
\t\treturn count;
""",
    # Where a connector is made.
    "\tdrm_connector_helper_add(&connector->base, &vkms_conn_helper_funcs);\n": """\
\tdrm_atomic_helper_connector_reset(&connector->base);
\tdrm_connector_attach_edid_property(&connector->base);
\tdrm_connector_attach_broadcast_rgb_property(&connector->base);
\tdrm_connector_attach_max_bpc_property(&connector->base, 6, 12);
""",
}


def patched(text: str) -> str:
    """The file's text with all additions."""
    for line, addition in ADDITIONS.items():
        if text.count(line) != 1:
            raise SystemExit(f"vkms: {text.count(line)} lines are {line.strip()!r}, expected one: is this another kernel?")
        text = text.replace(line, line + addition)
    return text


source = Path(sys.argv[1])
source.write_text(patched(source.read_text()))
