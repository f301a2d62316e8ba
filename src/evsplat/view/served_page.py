"""viser's page, which finds the server that it lost as soon as it is seen again."""

import gzip

from websockets.http11 import Response

_SCRIPT = b"""<script>
// The page looks for its server while it has the focus, which a tab that is opened again after its
// address was typed has not, nor a window beside the one that is worked in. Seen is enough.
document.hasFocus = () => document.visibilityState === "visible";
document.addEventListener("visibilitychange", () => window.dispatchEvent(new Event("focus")));
</script>"""
_BEFORE = b"<head>"


def found_when_seen(response: Response) -> Response:
    """The answer to a page's request as the viewer gives it; one that is no page stays as it is."""
    headers = response.headers
    if not headers.get("Content-Type", "").startswith("text/html"):
        return response
    packed = headers.get("Content-Encoding") == "gzip"
    page = gzip.decompress(response.body) if packed else response.body
    page = page.replace(_BEFORE, _BEFORE + _SCRIPT, 1)
    response.body = gzip.compress(page, compresslevel=1) if packed else page
    del headers["Content-Length"]
    headers["Content-Length"] = str(len(response.body))
    return response
