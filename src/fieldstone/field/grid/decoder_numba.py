"""The decoder in eight lanes of hidden units, and its gradient.

Two samples go through the layer together, so that each weight is loaded once for both. Arrays of samples are flat.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np
from numba import njit

from fieldstone.field.grid.decoder import DIRECTIONS, HIDDEN
from fieldstone.field.grid.simd_numba import (
    add8,
    at,
    fma8,
    load8,
    mul8,
    positive8,
    spread8,
    spread8_at,
    store8,
    sum8,
    where_nonzero8,
)

GROUP = 64
"""Samples whose gradients are summed up before they are added to the gradient of the weights."""


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
@no_type_check
def _basis(directions, ray, out):
    """`decoder.direction_basis` of one direction."""
    x, y, z = at(directions, ray * 3), at(directions, ray * 3 + 1), at(directions, ray * 3 + 2)
    out[0], out[1], out[2] = x, y, z
    out[3], out[4], out[5] = x * y, y * z, x * z
    out[6], out[7] = x * x - y * y, np.float32(3) * z * z - np.float32(1)


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def decode_directions(decoder, directions, num_rays, out):  # (r, 3) -> (r, hidden)
    """The part of the hidden layer that is the same for all samples of a ray."""
    basis = np.empty(DIRECTIONS, np.float32)
    for ray in range(num_rays):
        _basis(directions, ray, basis)
        for q in range(0, HIDDEN, 8):
            value = load8(decoder.hidden_bias, q)
            for k in range(DIRECTIONS):
                value = fma8(spread8_at(basis, k), load8(decoder.direction_weights, k * HIDDEN + q), value)
            store8(out, ray * HIDDEN + q, value)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
@no_type_check
def _sigmoid(x):
    return np.float32(1) / (np.float32(1) + math.exp(-x))


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def decode_numba(decoder, num_samples, features, width, used, ray, per_ray, hidden, rgb):
    """`decoder.decode`; keeps the hidden layer for `decode_backward`.

    features: (s, width), of which the first `used` count. ray: (s,) row of each sample in per_ray (r, hidden).
    hidden: (s, hidden). rgb: (s, 3).
    """
    zero = spread8(0)
    c = decoder.color_bias
    for i in range(0, num_samples, 2):
        j = min(i + 1, num_samples - 1)
        ri, rj = np.int64(at(ray, i)) * HIDDEN, np.int64(at(ray, j)) * HIDDEN
        r_i, g_i, b_i, r_j, g_j, b_j = zero, zero, zero, zero, zero, zero
        for q in range(0, HIDDEN, 8):
            h_i, h_j = load8(per_ray, ri + q), load8(per_ray, rj + q)
            for level in range(0, used, 4):
                for k in range(level + 1, level + 4):
                    w = load8(decoder.feature_weights, k * HIDDEN + q)
                    h_i = fma8(spread8_at(features, i * width + k), w, h_i)
                    h_j = fma8(spread8_at(features, j * width + k), w, h_j)
            h_i, h_j = positive8(h_i), positive8(h_j)
            store8(hidden, i * HIDDEN + q, h_i)
            store8(hidden, j * HIDDEN + q, h_j)
            w = load8(decoder.color_weights, q)
            r_i, r_j = fma8(h_i, w, r_i), fma8(h_j, w, r_j)
            w = load8(decoder.color_weights, HIDDEN + q)
            g_i, g_j = fma8(h_i, w, g_i), fma8(h_j, w, g_j)
            w = load8(decoder.color_weights, 2 * HIDDEN + q)
            b_i, b_j = fma8(h_i, w, b_i), fma8(h_j, w, b_j)
        rgb[i * 3] = _sigmoid(sum8(r_i) + c[0])
        rgb[i * 3 + 1] = _sigmoid(sum8(g_i) + c[1])
        rgb[i * 3 + 2] = _sigmoid(sum8(b_i) + c[2])
        rgb[j * 3] = _sigmoid(sum8(r_j) + c[0])
        rgb[j * 3 + 1] = _sigmoid(sum8(g_j) + c[1])
        rgb[j * 3 + 2] = _sigmoid(sum8(b_j) + c[2])


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def decode_backward(
    decoder,
    transposed,
    num_samples,
    num_rays,
    features,
    width,
    used,
    ray,
    directions,
    hidden,
    d_color,
    d_log_density,
    d_per_ray,
    grad,
):
    """Add the gradient of the weights to `grad`, and put that of the features in their place.

    transposed: F as (hidden, width). d_color: (s, 3) gradient before the sigmoid. d_raw: (s,) gradient of the raw
    density, written to the first channel of every level, since it is their sum. hidden is overwritten with its
    gradient, d_per_ray (r, hidden) with that of the rays' part.
    """
    zero = spread8(0)
    for i in range(0, num_rays * HIDDEN, 8):
        store8(d_per_ray, i, zero)
    for start in range(0, num_samples, GROUP):
        end = min(start + GROUP, num_samples)
        _hidden_backward(decoder, start, end, ray, hidden, d_color, d_per_ray, grad)
        for level in range(0, used, 4):
            for q in range(0, HIDDEN, 8):
                g_1, g_2, g_3 = zero, zero, zero
                for i in range(start, end):
                    d = load8(hidden, i * HIDDEN + q)
                    f = i * width + level
                    g_1 = fma8(spread8_at(features, f + 1), d, g_1)
                    g_2 = fma8(spread8_at(features, f + 2), d, g_2)
                    g_3 = fma8(spread8_at(features, f + 3), d, g_3)
                w = (level + 1) * HIDDEN + q
                store8(grad.feature_weights, w, add8(g_1, load8(grad.feature_weights, w)))
                store8(grad.feature_weights, w + HIDDEN, add8(g_2, load8(grad.feature_weights, w + HIDDEN)))
                store8(grad.feature_weights, w + 2 * HIDDEN, add8(g_3, load8(grad.feature_weights, w + 2 * HIDDEN)))
        for i in range(start, end, 2):
            j = min(i + 1, end - 1)
            for k in range(0, width, 8):
                d_i, d_j = zero, zero
                for h in range(HIDDEN):
                    w = load8(transposed, h * width + k)
                    d_i = fma8(spread8_at(hidden, i * HIDDEN + h), w, d_i)
                    d_j = fma8(spread8_at(hidden, j * HIDDEN + h), w, d_j)
                store8(features, i * width + k, d_i)
                store8(features, j * width + k, d_j)
            for level in range(0, used, 4):
                features[i * width + level] = at(d_log_density, i)
                features[j * width + level] = at(d_log_density, j)
    _rays_backward(num_rays, directions, d_per_ray, grad)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
@no_type_check
def _hidden_backward(decoder, start, end, ray, hidden, d_color, d_per_ray, grad):
    """Gradient of C and c, of the hidden layer in its place, and of the rays' part."""
    zero = spread8(0)
    for q in range(0, HIDDEN, 8):
        g_r, g_g, g_b = zero, zero, zero
        w_r, w_g = load8(decoder.color_weights, q), load8(decoder.color_weights, HIDDEN + q)
        w_b = load8(decoder.color_weights, 2 * HIDDEN + q)
        for i in range(start, end):
            r, g, b = spread8_at(d_color, i * 3), spread8_at(d_color, i * 3 + 1), spread8_at(d_color, i * 3 + 2)
            h = load8(hidden, i * HIDDEN + q)
            g_r, g_g, g_b = fma8(r, h, g_r), fma8(g, h, g_g), fma8(b, h, g_b)
            d = where_nonzero8(h, fma8(r, w_r, fma8(g, w_g, mul8(b, w_b))), zero)
            store8(hidden, i * HIDDEN + q, d)
            o = np.int64(at(ray, i)) * HIDDEN + q
            store8(d_per_ray, o, add8(d, load8(d_per_ray, o)))
        store8(grad.color_weights, q, add8(g_r, load8(grad.color_weights, q)))
        store8(grad.color_weights, HIDDEN + q, add8(g_g, load8(grad.color_weights, HIDDEN + q)))
        store8(grad.color_weights, 2 * HIDDEN + q, add8(g_b, load8(grad.color_weights, 2 * HIDDEN + q)))
    for i in range(start, end):
        for c in range(3):
            grad.color_bias[c] += at(d_color, i * 3 + c)


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _rays_backward(num_rays, directions, d_per_ray, grad):
    """Gradient of D and b."""
    basis = np.empty(DIRECTIONS, np.float32)
    for ray in range(num_rays):
        _basis(directions, ray, basis)
        for q in range(0, HIDDEN, 8):
            d = load8(d_per_ray, ray * HIDDEN + q)
            store8(grad.hidden_bias, q, add8(d, load8(grad.hidden_bias, q)))
            for k in range(DIRECTIONS):
                o = k * HIDDEN + q
                store8(grad.direction_weights, o, fma8(spread8_at(basis, k), d, load8(grad.direction_weights, o)))
