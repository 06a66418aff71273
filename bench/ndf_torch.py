"""The peer: NDF's occupancy network, point descriptors and trajectory energy in PyTorch with autograd.

It follows the published code: a batch is (objects, channels, 3, points), a latent is repeated for every query point and
concatenated with it, and a descriptor concatenates the layers of the decoder. Modules have the names of the published
checkpoints, so `load_state_dict` reads them unchanged.
"""

import dataclasses

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

SCALING = 10.0  # factor on all coordinates before the network
SLOPE = 0.2
NEIGHBOURS = 20
BLOCKS = 5
HIDDEN, WIDTH = 128, 256  # channels of the encoder, for latents of any size
EPSILON = 1e-6  # added to |d|^2


def last(x: Tensor) -> Tensor:
    """Move the channels to the last axis, as `nn.Linear` needs them.

    The result is contiguous, because `linear` of recorded tensors copies them anyway, and because it would otherwise
    run many small and slow products where nothing is recorded.
    """
    return x.transpose(1, -1).contiguous()


class VectorLinear(nn.Module):
    """A linear map of vector channels, (batch, channels, 3, ...)."""

    def __init__(self, inputs: int, outputs: int):
        super().__init__()
        self.map_to_feat = nn.Linear(inputs, outputs, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        """The output of the module."""
        return self.map_to_feat(last(x)).transpose(1, -1)


def reflect(x: Tensor, direction: Tensor) -> Tensor:
    """Vector leaky ReLU; the vectors' axis is 2."""
    inner = (x * direction).sum(2, keepdim=True)
    squared = (direction * direction).sum(2, keepdim=True)
    return torch.where(inner >= 0, x, x - (1 - SLOPE) * inner / (squared + EPSILON) * direction)


class VectorLeakyReLU(nn.Module):
    """A leaky ReLU of vector channels along learned directions."""

    def __init__(self, channels: int):
        super().__init__()
        self.map_to_dir = nn.Linear(channels, channels, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        """The output of the module."""
        return reflect(x, self.map_to_dir(last(x)).transpose(1, -1))


class EdgeConvolution(nn.Module):
    """Vector linear map and leaky ReLU of edge features, (batch, 3, 3, points, neighbours)."""

    def __init__(self, channels: int):
        super().__init__()
        self.map_to_feat = nn.Linear(3, channels, bias=False)
        self.map_to_dir = nn.Linear(3, channels, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        """The output of the module."""
        features = last(x)
        return reflect(self.map_to_feat(features).transpose(1, -1), self.map_to_dir(features).transpose(1, -1))


def edge_features(points: Tensor) -> Tensor:
    """(batch, points, 3) -> (batch, 3 features, 3, points, neighbours): neighbour - x, x, neighbour x x."""
    squared = (points * points).sum(-1)
    distances = squared[:, :, None] - 2 * points @ points.transpose(1, 2) + squared[:, None, :]
    nearest = distances.topk(NEIGHBOURS, dim=-1, largest=False).indices
    batch = torch.arange(len(points), device=points.device)[:, None, None]
    neighbours = points[batch, nearest]  # (batch, points, neighbours, 3)
    own = points[:, :, None].expand_as(neighbours)
    features = torch.stack([neighbours - own, own, torch.cross(neighbours, own, dim=-1)], dim=1)
    return features.permute(0, 1, 4, 2, 3)


class VectorBlock(nn.Module):
    """A residual block of vector channels."""

    def __init__(self, inputs: int, outputs: int):
        super().__init__()
        self.actvn_0, self.fc_0 = VectorLeakyReLU(inputs), VectorLinear(inputs, outputs)
        self.actvn_1, self.fc_1 = VectorLeakyReLU(outputs), VectorLinear(outputs, outputs)
        self.shortcut = VectorLinear(inputs, outputs)

    def forward(self, x: Tensor) -> Tensor:
        """The output of the module."""
        return self.shortcut(x) + self.fc_1(self.actvn_1(self.fc_0(self.actvn_0(x))))


class Encoder(nn.Module):
    """Centred clouds (batch, points, 3), metres -> latents (batch, latent, 3)."""

    def __init__(self, latent: int):
        super().__init__()
        self.conv_pos, self.fc_pos = EdgeConvolution(HIDDEN), VectorLinear(HIDDEN, WIDTH)
        for index in range(BLOCKS):
            setattr(self, f"block_{index}", VectorBlock(WIDTH, HIDDEN))
        self.actvn_c, self.fc_c = VectorLeakyReLU(HIDDEN), VectorLinear(HIDDEN, latent)

    def forward(self, points: Tensor) -> Tensor:
        """The output of the module."""
        x = self.fc_pos(self.conv_pos(edge_features(points * SCALING)).mean(-1))
        for index in range(BLOCKS):
            x = getattr(self, f"block_{index}")(x)
            if index + 1 < BLOCKS:
                x = torch.cat([x, x.mean(-1, keepdim=True).expand_as(x)], dim=1)
        return self.fc_c(self.actvn_c(x.mean(-1)))


class Block(nn.Module):
    """A residual block of the decoder."""

    def __init__(self, width: int):
        super().__init__()
        self.fc_0, self.fc_1 = nn.Linear(width, width), nn.Linear(width, width)

    def forward(self, x: Tensor) -> Tensor:
        """The output of the module."""
        return x + self.fc_1(F.relu(self.fc_0(F.relu(x))))


class Decoder(nn.Module):
    """The occupancy decoder, conditioned on a latent."""

    def __init__(self, latent: int, width: int):
        super().__init__()
        self.z_in, self.fc_in = VectorLinear(latent, latent), nn.Linear(2 * latent + 1, width)
        for index in range(BLOCKS):
            setattr(self, f"block{index}", Block(width))
        self.fc_out = nn.Linear(width, 1)

    def forward(self, x: Tensor, latent: Tensor) -> tuple[list[Tensor], Tensor]:
        """Layers, and logits (batch, queries), of points (batch, queries, 3) relative to the centroid, and latents."""
        p = x * SCALING
        invariants = (latent * self.z_in(latent)).sum(-1)[:, None].repeat(1, p.shape[1], 1)
        layers = [torch.cat([(p * p).sum(-1, keepdim=True), p @ latent.transpose(1, 2), invariants], dim=-1)]
        h = self.fc_in(layers[0])
        layers.append(h)
        for index in range(BLOCKS):
            h = getattr(self, f"block{index}")(h)
            layers.append(h)
        return layers, self.fc_out(F.leaky_relu(h, SLOPE)).squeeze(-1)


class OccupancyNetwork(nn.Module):
    """Encoder and decoder, under the published checkpoints' names."""

    def __init__(self, latent: int, width: int):
        super().__init__()
        self.encoder, self.decoder = Encoder(latent), Decoder(latent, width)

    def descriptors(self, x: Tensor, latent: Tensor) -> Tensor:
        """Unit-length point descriptors (batch, queries, channels)."""
        return F.normalize(torch.cat(self.decoder(x, latent)[0], dim=-1), dim=-1)

    def occupancy(self, x: Tensor, latent: Tensor) -> Tensor:
        """Probabilities (batch, queries)."""
        return torch.sigmoid(self.decoder(x, latent)[1])


def load(state: dict[str, np.ndarray], dtype: torch.dtype = torch.float32) -> OccupancyNetwork:
    """The network with a checkpoint's tensors, (out, in)."""
    network = OccupancyNetwork(len(state["encoder.fc_c.map_to_feat.weight"]), len(state["decoder.fc_in.bias"])).to(
        dtype
    )
    network.load_state_dict({name: torch.tensor(tensor, dtype=dtype) for name, tensor in state.items()})
    return network.eval()


@dataclasses.dataclass(frozen=True)
class Problem:
    """What a trajectory is compared with, and the object it is for.

    Attributes:
        latents: the object's, once for every start, (starts, latent, 3).
        origin: mean of the object's cloud, metres, world frame.
        query: query points in the query frame, (queries, 3).
        descriptors: the demonstration's, (poses, queries, channels).
        R_ref, t_ref: the demonstration's poses relative to its cloud's mean.
        correlation: weight k of the pose term.
        rotation_scale: metres per radian in the pose term.
    """

    latents: Tensor
    origin: Tensor
    query: Tensor
    descriptors: Tensor
    R_ref: Tensor
    t_ref: Tensor
    correlation: float
    rotation_scale: float


def exponential(rotation_vector: Tensor) -> Tensor:
    """Matrices of rotation vectors, (..., 3); unlike the published Rodrigues formula it has a gradient at zero."""
    x, y, z = rotation_vector.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.matrix_exp(torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3)))


def descriptor_losses(
    network: OccupancyNetwork, problem: Problem, R: Tensor, centroid: Tensor, first: int = 0
) -> Tensor:
    """Mean absolute differences of descriptors over poses, queries and channels, (starts,).

    Args:
        network: the network.
        problem: the demonstration and the target.
        R: orientations, (starts, poses, 3, 3).
        centroid: positions of the centroid of the query points, (starts, poses, 3), world frame.
        first: number of the demonstrated pose that the first pose is compared with.
    """
    starts, n = centroid.shape[:2]
    centred = problem.query - problem.query.mean(0)
    x = centred @ R.transpose(-1, -2) + centroid[:, :, None]
    found = network.descriptors((x - problem.origin).reshape(starts, -1, 3), problem.latents)
    there = problem.descriptors[first : first + n].reshape(-1, found.shape[-1])
    return torch.stack([F.l1_loss(one, there) for one in found])


def pose_losses(problem: Problem, R: Tensor, centroid: Tensor) -> Tensor:
    """K ||T_ref - T||, mean over poses, (starts,); the norm is zero with gradient zero where they agree."""
    shift = centroid - R @ problem.query.mean(0) - problem.origin - problem.t_ref
    rotation = problem.rotation_scale * (R - problem.R_ref).flatten(-2)
    return problem.correlation * torch.linalg.vector_norm(torch.cat([shift, rotation], dim=-1), dim=-1).mean(-1)
