"""Pictures within the pages of results, as small JPEG."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

WIDTH, QUALITY = 900, 65


def embed_picture(file: Path, alt: str) -> dict[str, Any] | None:
    """Return a picture for a page: JPEG as base64, its alternative text, width and height; None for a file that is no picture."""
    import cv2

    image = cv2.imread(str(file))
    if image is None:
        return None
    height = round(image.shape[0] * WIDTH / image.shape[1])
    small = cv2.resize(image, (WIDTH, height), interpolation=cv2.INTER_AREA)
    data = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1].tobytes()
    return {"data": base64.b64encode(data).decode(), "alt": alt, "width": WIDTH, "height": height}
