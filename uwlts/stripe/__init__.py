"""Sub-pixel centre of the laser stripe, one per profile line.

A profile line is an image row if the stripe runs along the image height, an image column if it runs along the width.

The steps: `extract` finds places on each line that may contain a stripe. `search` examines these places by the rules
for several peaks. `peak_window` measures each peak, `methods` locate its centre, and `extract` combines all steps and
assigns a status to each line. `direct` separates the laser's own stripe from reflections. `capture_stripes`
processes all laser images of a capture and explains missing stripes.
"""

from uwlts.model.stripe import CaptureStripes, Stripe, StripeCandidates, StripeStatus
from uwlts.stripe.capture_stripes import explain_missing_stripe, find_stripes
from uwlts.stripe.extract import extract_candidates, extract_stripe, warm_up
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
    "explain_missing_stripe",
    "extract_candidates",
    "extract_stripe",
    "find_stripes",
    "method_names",
    "warm_up",
]
