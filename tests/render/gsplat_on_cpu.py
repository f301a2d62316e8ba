"""gsplat with its compiled kernels replaced by plain torch: its Python runs here as on a GPU.

Shapes, checks and autograd functions are gsplat's own. The kernels below are written from the rules
of gsplat's .cu files, in float32 with the same formulas, so that what float32 loses there is lost
here too; only the fast-math exponential is not imitated. Values that the kernels leave
uninitialised are NaN here.
"""

import math
from types import SimpleNamespace

import torch

ALPHA = 1 / 255


def install(monkeypatch):
    """The package gsplat, patched for one test."""
    import gsplat
    from gsplat.cuda import _wrapper

    kernels = SimpleNamespace(
        projection_ewa_3dgs_fused_fwd=project,
        projection_ewa_3dgs_fused_bwd=project_backward,
        intersect_tile=intersect,
        intersect_offset=offsets,
        rasterize_to_pixels_3dgs_fwd=rasterize,
        rasterize_to_pixels_3dgs_bwd=rasterize_backward,
    )
    monkeypatch.setattr(_wrapper, "_make_lazy_cuda_func", lambda name: getattr(kernels, name))
    monkeypatch.setattr(_wrapper, "_make_lazy_cuda_obj", lambda name: name)
    return gsplat


def _screen(means, covars, quats, scales, viewmats, Ks, width, height, eps2d):
    """Centres, 2-D covariances (a, b, c) and depths; (B, C, N, ...)."""
    from gsplat.cuda._torch_impl import _persp_proj, _quat_scale_to_covar_preci, _world_to_cam

    if covars is None:
        covars = _quat_scale_to_covar_preci(quats, scales, True, False)[0]
    else:
        index = torch.tensor([0, 1, 2, 1, 3, 4, 2, 4, 5])
        covars = covars[..., index].unflatten(-1, (3, 3))
    means_c, covars_c = _world_to_cam(means, covars, viewmats)
    centers, cov = _persp_proj(means_c, covars_c, Ks, width, height)
    a, b, c = cov[..., 0, 0] + eps2d, cov[..., 0, 1], cov[..., 1, 1] + eps2d
    return centers, (a, b, c), means_c[..., 2]


def _conics(a, b, c):
    determinant = a * c - b * b
    return torch.stack([c, -b, a], -1) / determinant[..., None]


def project(
    means, covars, quats, scales, opacities, viewmats, Ks, width, height, eps2d, near, far,
    radius_clip, calc_compensations, camera_model,
):  # fmt: skip
    assert camera_model == "CameraModelType.PINHOLE" and not calc_compensations
    assert all(value.is_contiguous() for value in (means, viewmats, Ks))
    centers, (a, b, c), depths = _screen(
        means, covars, quats, scales, viewmats, Ks, width, height, eps2d
    )
    extent = torch.full_like(depths, 3.33)
    culled = (depths < near) | (depths > far) | (a * c - b * b <= 0)
    if opacities is not None:
        culled |= opacities[..., None, :] < ALPHA
        reach = (2 * (opacities / ALPHA).log()).sqrt()[..., None, :]
        extent = torch.fmin(extent, reach)
    radii = (extent[..., None] * torch.stack([a, c], -1).sqrt()).ceil()
    culled |= (radii <= radius_clip).all(-1)
    size = torch.tensor([width, height])
    culled |= ((centers + radii <= 0) | (centers - radii >= size)).any(-1)
    # A float that is no number becomes the integer 0, a too large one the largest.
    radii = radii.nan_to_num(0.0, posinf=2.0**31 - 128).clamp(max=2.0**31 - 128).int()
    radii[culled] = 0
    conics = _conics(a, b, c)
    for value in (centers, depths, conics):
        value[culled] = math.nan
    return radii, centers, depths, conics, None


def project_backward(
    means, covars, quats, scales, viewmats, Ks, width, height, eps2d, camera_model, radii, conics,
    compensations, v_means2d, v_depths, v_conics, v_compensations, viewmats_requires_grad,
):  # fmt: skip
    inputs = [means, covars, quats, scales, viewmats]
    leaves = [None if value is None else value.detach().requires_grad_() for value in inputs]
    drawn = (radii > 0).all(-1)[..., None]
    with torch.enable_grad():
        # What is culled has no gradient, and its numbers must not get into that of the rest.
        safe = [*leaves[:4]]
        outputs = _screen(*safe, leaves[4], Ks, width, height, eps2d)
        centers, abc, depths = outputs
        values = (centers, _conics(*abc), depths[..., None])
        total = sum(
            torch.where(drawn, value, 0.0).mul(torch.where(drawn, upstream, 0.0)).sum()
            for value, upstream in zip(
                values, (v_means2d, v_conics, v_depths[..., None]), strict=True
            )
        )
    wanted = [leaf for leaf in leaves if leaf is not None]
    found = iter(torch.autograd.grad(total, wanted, allow_unused=True))
    return tuple(None if leaf is None else next(found).nan_to_num(0.0) for leaf in leaves)


def _tiles(means2d, radii, tile_size, across, down):
    size = torch.tensor([across, down])
    middle, reach = means2d / tile_size, radii / tile_size
    low = (middle - reach).floor().nan_to_num(0).clamp(min=0).minimum(size).long()
    high = (middle + reach).ceil().nan_to_num(0).clamp(min=0).minimum(size).long()
    return low, high


def intersect(
    means2d, radii, depths, image_ids, gaussian_ids, images, tile_size, across, down, sort,
    segmented,
):  # fmt: skip
    assert image_ids is None and gaussian_ids is None and sort and not segmented
    assert not means2d.requires_grad and means2d.shape[0] == images
    low, high = _tiles(means2d, radii, tile_size, across, down)
    drawn = (radii > 0).all(-1)
    keys, ids = [], []
    count = radii.shape[1]
    for image, row in drawn.nonzero().tolist():
        (x0, y0), (x1, y1) = low[image, row].tolist(), high[image, row].tolist()
        depth = depths[image, row].view(torch.int32).item()
        for tile in (y * across + x for y in range(y0, y1) for x in range(x0, x1)):
            keys.append((image * across * down + tile) << 32 | depth)
            ids.append(image * count + row)
    order = torch.tensor(keys, dtype=torch.int64).sort(stable=True)
    counts = ((high - low).prod(-1) * drawn).int()
    return counts, order.values, torch.tensor(ids, dtype=torch.int32)[order.indices]


def offsets(pairs, images, across, down):
    tiles = torch.arange(images * across * down)
    found = torch.searchsorted(pairs >> 32, tiles).int()
    return found.view(images, down, across)


def _pixels(means2d, conics, colors, opacities, masks, width, height, tile_size, starts, order):
    """Colours and alpha, differentiable; the sums run front to back over each tile's list.

    Where ``masks`` says no, colours are 0 and nothing is written to alpha.
    """
    images, down, across = starts.shape
    ends = torch.cat([starts.flatten()[1:], torch.tensor([len(order)])]).view_as(starts)
    flat = [means2d, conics, colors, opacities]
    if means2d.dim() > 2:
        flat = [value.flatten(0, 1) for value in flat]
    picture = colors.new_zeros(images, height, width, colors.shape[-1] + 1)
    for image in range(images):
        for row in range(down):
            for column in range(across):
                top, left = row * tile_size, column * tile_size
                if masks is not None and not masks[image, row, column]:
                    hidden = picture[image, top : top + tile_size, left : left + tile_size]
                    hidden[..., -1] = math.nan
                    continue
                y = torch.arange(top, min(top + tile_size, height))
                x = torch.arange(left, min(left + tile_size, width))
                start, end = starts[image, row, column], ends[image, row, column]
                chosen = order[start:end].long()
                xy, conic, colour, opacity = (value[chosen] for value in flat)
                py, px = torch.meshgrid(y + 0.5, x + 0.5, indexing="ij")
                dx = xy[:, 0] - px[..., None]
                dy = xy[:, 1] - py[..., None]
                sigma = (
                    0.5 * (conic[:, 0] * dx * dx + conic[:, 2] * dy * dy) + conic[:, 1] * dx * dy
                )
                alpha = (opacity * torch.exp(-sigma)).clamp(max=0.999)
                alpha = torch.where((sigma < 0) | (alpha < ALPHA), 0.0, alpha)
                after = torch.cumprod(1 - alpha, -1)
                alpha = torch.where(after > 1e-4, alpha, 0.0)
                after = torch.cumprod(1 - alpha, -1)
                before = torch.cat([torch.ones_like(dx[..., :1]), after[..., :-1]], -1)
                weight = alpha * before
                values = torch.cat([weight @ colour, weight.sum(-1, keepdim=True)], -1)
                picture[image, top : top + len(y), left : left + len(x)] = values
    return picture[..., :-1], picture[..., -1:]


def rasterize(
    means2d, conics, colors, opacities, backgrounds, masks, width, height, tile_size, starts, order
):
    assert backgrounds is None and starts.dtype == order.dtype == torch.int32
    assert all(value.is_contiguous() for value in (means2d, conics, colors, opacities))
    colours, alpha = _pixels(
        means2d, conics, colors, opacities, masks, width, height, tile_size, starts, order
    )
    return colours, alpha, torch.zeros(alpha.shape[:-1], dtype=torch.int32)


def rasterize_backward(
    means2d, conics, colors, opacities, backgrounds, masks, width, height, tile_size, starts,
    order, alphas, last_ids, v_colors, v_alphas, absgrad,
):  # fmt: skip
    leaves = [value.detach().requires_grad_() for value in (means2d, conics, colors, opacities)]
    with torch.enable_grad():
        colours, alpha = _pixels(*leaves, masks, width, height, tile_size, starts, order)
        # Tiles that are masked have no gradient, whatever comes for them.
        total = sum(
            torch.where(value.isnan(), 0.0, value * upstream).sum()
            for value, upstream in ((colours, v_colors), (alpha, v_alphas))
        )
    found = torch.autograd.grad(total, leaves)
    return None, *found
