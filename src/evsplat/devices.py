"""Moving tensors to a device without waiting for it."""

import torch
from torch import Tensor


def send(tensor: Tensor, device: torch.device | str) -> Tensor:
    """``tensor`` on ``device``; the host does not wait for the copy.

    A plain ``.to`` of pageable memory makes the host wait until the device has done all its work so
    far. Pinned memory stays reserved until the copy is made, so the caller need not keep anything.
    """
    device = torch.device(device)
    if tensor.device.type != "cpu" or device.type == "cpu":
        return tensor.to(device)
    if device.type == "cuda" and not tensor.requires_grad:
        tensor = tensor.pin_memory()
    return tensor.to(device, non_blocking=True)
