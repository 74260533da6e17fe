"""Names for the tensors that pass between modules. Shapes use ``*`` for any leading batch."""

from __future__ import annotations

from typing import TypeAlias

from torch import Tensor

Image: TypeAlias = Tensor
"""(*, 3, H, W) display-encoded (sRGB) colour in [0, 1]; grey shading is (*, 1, H, W)."""

Normals: TypeAlias = Tensor
"""(*, 3, H, W) unit vectors, +x right, +y up, +z to the viewer."""

Mask: TypeAlias = Tensor
"""(*, 1, H, W) in [0, 1]."""

Params: TypeAlias = Tensor
"""(*, n) the numbers of one parameter: 3 for a direction or a colour, 1 for a scalar."""
