"""What training compares: brightness changes that events tell, and the blur that they undo."""

import torch

import evsplat as ev
from evsplat.events import count_map, deblur
from evsplat.pictures import log_brightness_change
from evsplat.shipped import demo_capture

capture = ev.load_capture(demo_capture())
before, after = capture.frames[4], capture.frames[5]
events = capture.events.between(before.mid_us, after.mid_us)
given = count_map(events, capture.events.height, capture.events.width)

# The change of log brightness between two sharp moments is the signed count times the threshold.
change = log_brightness_change(capture.sharp(before), capture.sharp(after))
cosine = torch.nn.functional.cosine_similarity(change.flatten(), given.flatten(), dim=0)
print(f"events and change of brightness: cosine {cosine:.3f}")

# EDI: a blurry frame and the events of its exposure give the sharp picture at its middle.
blurry, sharp = capture.image(after), capture.sharp(after)
events = capture.events.between(*after.exposure_us)
restored = deblur(
    blurry, events, after.exposure_us, [after.mid_us], capture.contrast_threshold or (0.2, 0.2)
)[0]
for name, picture in (("blurry", blurry), ("after EDI", restored)):
    print(f"{name}: {-10 * (picture - sharp).square().mean().log10():.2f} dB")
