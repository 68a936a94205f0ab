"""The compiled functions of a tanh network: outputs, and gradients by backpropagation (numba).

For networks of 64 units the calls of a tensor library cost more than the work in them. All
arithmetic is float32 in a fixed order: the same bits on every processor, for one state or many.

A network is a flat vector of parameters and its sizes, int64 [layers + 1]. A layer's parameters are
its weights and, as the last row, its biases, [in + 1, padded out]: columns of zeros are added up to
a multiple of 16, for `matmul`. Their gradient is 0, so they stay zeros.
"""

import math

import numpy as np

from mace_rl.numerics.compiling import kernel
from mace_rl.numerics.elementary import f32, tanh
from mace_rl.numerics.matmul import Matrix, add_product, address, by_tiles, dot, padded, product

FEW = 4  # columns of a last layer; a tile computes 16 at once


@kernel
def activation_buffer(count, sizes):
    """A buffer for every layer's outputs for `count` inputs, flat: [count, padded out] each."""
    width = 0
    for outs in sizes[1:]:
        width += padded(outs)
    return np.empty(count * width, np.float32)


@kernel
def forward(inputs, parameters, sizes, activations):
    """A tanh network's outputs for N inputs, a view of `activations`, [N, padded out].

    inputs: [N, in]; activations: from `activation_buffer` for at least N, filled in.
    """
    below, weights, end = Matrix(address(inputs), inputs.shape[1], 1), address(parameters), 0
    for layer in range(len(sizes) - 1):
        ins, width = sizes[layer], padded(sizes[layer + 1])
        bias = weights + 4 * ins * width
        above = activations[end : end + len(inputs) * width]
        outputs, matrix = Matrix(address(above), width, 1), Matrix(weights, width, 1)
        by_tiles(below, matrix, Matrix(bias, 0, 1), outputs, len(inputs), width, ins)
        if layer < len(sizes) - 2:
            for k in range(len(above)):
                above[k] = tanh(above[k])
        below, weights, end = outputs, bias + 4 * width, end + len(above)
    return above.reshape(len(inputs), width)


@kernel
def transposed(parameters, sizes):
    """The weights of each layer, transposed for `backward`, [out, padded in]."""
    total = 0
    for layer in range(len(sizes) - 1):
        total += sizes[layer + 1] * padded(sizes[layer])
    result = np.zeros(total, np.float32)
    start = place = 0
    for layer in range(len(sizes) - 1):
        ins, outs = sizes[layer], sizes[layer + 1]
        end = start + (ins + 1) * padded(outs)
        weights = parameters[start:end].reshape(ins + 1, padded(outs))
        for j in range(outs):
            row = result[place : place + ins]
            for i in range(ins):
                row[i] = weights[i, j]
            place += padded(ins)
        start = end
    return result


@kernel
def backward(inputs, activations, grad_outputs, back, sizes, gradient, grad_activations):
    """Add a loss's gradient to `gradient`, like the parameters; returns that at the first layer.

    inputs, activations: of `forward`; grad_outputs: the loss's gradient at the outputs, [N, padded
    out], zeros in the columns added; back: the weights `transposed`; grad_activations: like
    `activations`, overwritten. The first layer's is before its tanh.
    """
    count, ones = len(inputs), np.ones((1, len(inputs)), np.float32)
    end = place = below_end = 0
    for layer in range(len(sizes) - 1):
        end += (sizes[layer] + 1) * padded(sizes[layer + 1])
        place += sizes[layer + 1] * padded(sizes[layer])
        if layer > 0:
            below_end += count * padded(sizes[layer])
    grad = grad_outputs
    for layer in range(len(sizes) - 2, -1, -1):
        ins, outs = sizes[layer], sizes[layer + 1]
        start = end - (ins + 1) * padded(outs)
        change = gradient[start:end].reshape(ins + 1, padded(outs))
        end = start
        add_product(ones, grad, change[ins:])
        if layer == 0:
            add_product(inputs.T, grad, change[:ins])
            break
        width = padded(ins)
        weights = back[place - outs * width : place].reshape(outs, width)
        place -= outs * width
        below_start = below_end - count * width
        below = activations[below_start:below_end]
        flat = grad_activations[below_start:below_end]
        below_end = below_start
        if outs <= FEW:
            add_by_columns(below.reshape(count, width), grad, change, outs)
        else:
            add_product(below.reshape(count, width).T, grad, change[:ins])
        grad_below = flat.reshape(count, width)
        product(grad, weights, np.zeros(width, np.float32), grad_below)
        for k in range(len(flat)):
            flat[k] *= f32(1) - below[k] * below[k]  # tanh'
        grad = grad_below
    return grad


@kernel
def add_by_columns(below, grad, change, outs):
    """C + Aᵀ · B for B with few columns that are not padding: with C's in the place of its rows.

    A, below: [N, padded in]; B, grad: [N, padded out]; C, the first rows of change, [in + 1, padded
    out]. The bits are those of `add_product`, since each element is the same chain.
    """
    columns = np.zeros((outs, below.shape[1]), np.float32)
    for i in range(len(change) - 1):
        for j in range(outs):
            columns[j, i] = change[i, j]
    add_product(grad.T[:outs], below, columns)
    for i in range(len(change) - 1):
        for j in range(outs):
            change[i, j] = columns[j, i]


@kernel
def network_outputs(inputs, parameters, sizes):
    """A tanh network's outputs for N inputs, [N, out], and its activations."""
    activations = activation_buffer(len(inputs), sizes)
    outputs = forward(inputs, parameters, sizes, activations)
    return outputs[:, : sizes[-1]].copy(), activations


@kernel
def network_gradient(inputs, activations, parameters, grad_outputs, sizes):
    """A loss's gradient, like the parameters, and what `backward` returns.

    activations: of `network_outputs`; grad_outputs: the loss's gradient at the outputs, [N, out].
    """
    padded_grad = np.zeros((len(inputs), padded(sizes[-1])), np.float32)
    padded_grad[:, : sizes[-1]] = grad_outputs
    gradient, scratch = np.zeros_like(parameters), np.empty_like(activations)
    back = transposed(parameters, sizes)
    return gradient, backward(inputs, activations, padded_grad, back, sizes, gradient, scratch)


@kernel
def input_gradient(grad_first, parameters, sizes):
    """A loss's gradient at the inputs, [N, in], from what `backward` returns."""
    outs, width = sizes[1], padded(sizes[0])
    weights = transposed(parameters, sizes)[: outs * width].reshape(outs, width)
    result = np.empty((len(grad_first), width), np.float32)
    product(grad_first, weights, np.zeros(width, np.float32), result)
    return result[:, : sizes[0]]


@kernel
def orthonormal(matrix):
    """Orthonormal columns that span what the columns of `matrix` do, float64 [M, N], M ≥ N.

    By Gram-Schmidt, twice against rounding. Of a Gaussian matrix the result is uniform.
    """
    result = matrix.copy()
    for j in range(result.shape[1]):
        column = result[:, j].copy()
        for before in range(2 * j):
            other = result[:, before % j].copy()
            along = dot(other, column)
            for i in range(len(column)):
                column[i] -= along * other[i]
        result[:, j] = column / math.sqrt(dot(column, column))
    return result
