"""The laser stripe's sub-pixel centre, one per profile line.

A profile line is an image row when the stripe runs along the image height, an image column when it runs along the
width. The steps: `block_contrast` finds where on each line a stripe may be, `search` looks at these places by the
rules about several peaks, `peak_window` measures what stands there, `methods` place the centre, `extract` does all this
and gives the statuses. `direct` tells the laser's own stripe from its reflections, `capture_stripes` does so for all
laser images and says why there is no stripe.
"""

from uwlts.model.stripe import CaptureStripes, Stripe, StripeCandidates, StripeStatus
from uwlts.stripe.capture_stripes import find_stripes, why_no_stripe
from uwlts.stripe.extract import extract_candidates, extract_stripe, stripe_in, warm_up
from uwlts.stripe.methods import method_names
from uwlts.stripe.options import PeakRule, StripeOptions, StripeSettings

__all__ = [
    "CaptureStripes",
    "PeakRule",
    "Stripe",
    "StripeCandidates",
    "StripeOptions",
    "StripeSettings",
    "StripeStatus",
    "extract_candidates",
    "extract_stripe",
    "find_stripes",
    "method_names",
    "stripe_in",
    "warm_up",
    "why_no_stripe",
]
