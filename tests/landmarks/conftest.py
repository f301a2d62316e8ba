import pytest

from evsplat.landmarks.network import LandmarkNetwork


@pytest.fixture(scope="session")
def network() -> LandmarkNetwork:
    """The one that ships."""
    return LandmarkNetwork()
