"""Where pixels enter: frames, decoders with limits, folders of images.

A file becomes a `Frame` only if it is whole, of a known format, within stated limits, and if
every grey value survives: the header is read and checked before OpenCV decodes a pixel, and
what OpenCV returns is compared with it. Nothing is turned, stretched or cut to 8 bits. Images
taken together form an `ImageSet`; sets are checked for orphans, duplicates and times, and
single frames for being blank or interlaced.
"""

from closerange.images.checks import (
    check_frame,
    check_interlace,
    comb_share,
    noise_level,
    structure_range,
)
from closerange.images.decode import MAX_IMAGE_BYTES, MAX_PIXELS, read_image
from closerange.images.exposures import (
    Exposures,
    check_exposures,
    read_exposures,
)
from closerange.images.folder import list_images, natural_key
from closerange.images.frame import Frame
from closerange.images.headers import ImageHeader, read_header
from closerange.images.image_sets import (
    ImageSet,
    check_duplicates,
    distinct,
    group_images,
    placement_and_reading,
    placement_name,
)

__all__ = [
    "MAX_IMAGE_BYTES",
    "MAX_PIXELS",
    "Exposures",
    "Frame",
    "ImageHeader",
    "ImageSet",
    "check_duplicates",
    "check_exposures",
    "check_frame",
    "check_interlace",
    "comb_share",
    "distinct",
    "group_images",
    "list_images",
    "natural_key",
    "noise_level",
    "placement_and_reading",
    "placement_name",
    "read_exposures",
    "read_header",
    "read_image",
    "structure_range",
]
