"""The laser stripe's sub-pixel centre, one per profile line.

A profile line is an image row when the stripe runs along the image height, an image column when it runs along the
width. The steps: `candidates` finds where on each line a stripe may be, `lobe` looks at those places closely,
`centre` places the centre, `extract` applies the rules about several peaks and hands out the statuses. `absence` says
why there is none.
"""

from uwlts.stripe.absence import why_no_stripe
from uwlts.stripe.extract import extract_stripe
from uwlts.stripe.recording import FoundStripes, find_stripes
from uwlts.stripe.result import PeakRule, Stripe, StripeMethod, StripeOptions, StripeStatus

__all__ = [
    "FoundStripes",
    "PeakRule",
    "Stripe",
    "StripeMethod",
    "StripeOptions",
    "StripeStatus",
    "extract_stripe",
    "find_stripes",
    "why_no_stripe",
]
