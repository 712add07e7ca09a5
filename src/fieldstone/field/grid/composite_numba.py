"""Samples along rays to colours, and back: the gradient of squared colour errors and of what else counts."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

from fieldstone.field.grid.simd_numba import at


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def composite_numba(samples, num_rays, first, end_transmittance, far, background, rgb, color, depth, opacity):
    """Colours, expected distances and opacities of rays from their samples, as `volume_rendering.composite`.

    background: (r, 3) flat. rgb: (s, 3) flat, colours of the samples. Light that passes ends at `far`.
    """
    for ray in range(num_rays):
        passed = end_transmittance[ray]
        r, g, b = passed * background[ray * 3], passed * background[ray * 3 + 1], passed * background[ray * 3 + 2]
        total, t = np.float32(0), np.float32(0)
        for i in range(first[ray], first[ray + 1]):
            weight = at(samples.transmittance, i) * at(samples.alpha, i)
            r += weight * at(rgb, i * 3)
            g += weight * at(rgb, i * 3 + 1)
            b += weight * at(rgb, i * 3 + 2)
            t += weight * at(samples.distance, i)
            total += weight
        color[ray, 0], color[ray, 1], color[ray, 2] = r, g, b
        depth[ray] = t + (np.float32(1) - total) * far
        opacity[ray] = total


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def composite_backward(samples, rays, work, num_rays, terms, scale):
    """Squared colour errors, summed up, and `scale` times half the gradient of this sum and of what else counts.

    A photo shows gain C: its exposure and white balance by channel. The opacity of a ray, 1 - T_end, counts
    `sparsity` times: fog in the colour of the background costs nothing else. Something solid in that colour does not
    feel it, since T_end is 0 anyhow: on rays that show the background exactly, sum log(1 + tau_i) counts `emptiness`
    times. Whatever else counts says by d_weight how it depends on the weight of each sample, see `ray_terms`.

    rays: a `RayBatch`. work: a `Work` with rgb and d_weight (half the derivative by w_i); written are d_color (before
    the sigmoid), d_log_density and d_gain (by the logarithm of the gain). terms: a `Terms`.

    Source:
        `max1995`, section 3, differentiated.
    """
    loss = _rays_backward(samples, rays, work, num_rays, scale)
    _samples_backward(samples, rays, work, num_rays, terms, scale)
    return loss


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _rays_backward(samples, rays, work, num_rays, scale):
    """Squared colour errors, and the gradients by the colour C and the gain of each ray."""
    background, target, gain = rays.background, rays.target, rays.gain
    rgb, d_gain, d_shown = work.rgb, work.d_gain, work.d_shown
    loss = 0.0
    for ray in range(num_rays):
        passed = rays.end_transmittance[ray]
        c0, c1, c2 = passed * background[ray * 3], passed * background[ray * 3 + 1], passed * background[ray * 3 + 2]
        for i in range(rays.first[ray], rays.first[ray + 1]):
            weight = at(samples.transmittance, i) * at(samples.alpha, i)
            c0 += weight * at(rgb, i * 3)
            c1 += weight * at(rgb, i * 3 + 1)
            c2 += weight * at(rgb, i * 3 + 2)
        r, g, b = gain[ray * 3], gain[ray * 3 + 1], gain[ray * 3 + 2]
        shown0, shown1, shown2 = r * c0, g * c1, b * c2
        e0, e1, e2 = shown0 - target[ray * 3], shown1 - target[ray * 3 + 1], shown2 - target[ray * 3 + 2]
        loss += e0 * e0 + e1 * e1 + e2 * e2
        d_gain[ray * 3], d_gain[ray * 3 + 1] = e0 * shown0 * scale, e1 * shown1 * scale
        d_gain[ray * 3 + 2] = e2 * shown2 * scale
        d_shown[ray * 3], d_shown[ray * 3 + 1] = e0 * r * scale, e1 * g * scale
        d_shown[ray * 3 + 2] = e2 * b * scale
    return loss


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _samples_backward(samples, rays, work, num_rays, terms, scale):
    """Gradients by the colour and the log density of each sample, from the last one of a ray to the first.

    With g the gradient by C and w_i = T_i alpha_i:
    dC / dtau_i = T_(i+1) c_i - sum_{j>i} w_j c_j - T_end background,  dtau / dlog_density = tau.
    """
    one, half = np.float32(1), np.float32(0.5)
    background, target, rgb, d_shown = rays.background, rays.target, work.rgb, work.d_shown
    d_color, d_log_density, d_weight = work.d_color, work.d_log_density, work.d_weight
    for ray in range(num_rays):
        b0, b1, b2 = background[ray * 3], background[ray * 3 + 1], background[ray * 3 + 2]
        g0, g1, g2 = d_shown[ray * 3], d_shown[ray * 3 + 1], d_shown[ray * 3 + 2]
        passed = rays.end_transmittance[ray]
        behind = passed * (b0 * g0 + b1 * g1 + b2 * g2)  # g times what is seen behind the samples that were done
        behind -= half * scale * terms.sparsity * passed
        bare = target[ray * 3] == b0 and target[ray * 3 + 1] == b1 and target[ray * 3 + 2] == b2
        thinner = half * scale * terms.emptiness if bare else np.float32(0)
        for i in range(rays.first[ray + 1] - 1, rays.first[ray] - 1, -1):
            transmittance, alpha = at(samples.transmittance, i), at(samples.alpha, i)
            weight = transmittance * alpha
            r, g, b = at(rgb, i * 3), at(rgb, i * 3 + 1), at(rgb, i * 3 + 2)
            of_sample = r * g0 + g * g1 + b * g2 + scale * at(d_weight, i)
            tau = at(samples.tau, i)
            d_log_density[i] = (transmittance * (one - alpha) * of_sample - behind + thinner / (one + tau)) * tau
            behind += weight * of_sample
            d_color[i * 3] = weight * g0 * r * (one - r)
            d_color[i * 3 + 1] = weight * g1 * g * (one - g)
            d_color[i * 3 + 2] = weight * g2 * b * (one - b)
