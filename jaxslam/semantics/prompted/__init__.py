"""Segmenters that are told what to segment: by points and boxes (SAM), or by an image with its mask (SegGPT)."""

from jaxslam.semantics.prompted.detector import PromptedDetector as PromptedDetector
from jaxslam.semantics.prompted.examples import Example as Example
from jaxslam.semantics.prompted.examples import read_examples as read_examples
from jaxslam.semantics.prompted.examples import with_masks as with_masks
from jaxslam.semantics.prompted.in_context import InContextDetector as InContextDetector
from jaxslam.semantics.prompted.in_context import load_in_context as load_in_context
from jaxslam.semantics.prompted.prompt import Prompt as Prompt
from jaxslam.semantics.prompted.prompt import prompt as prompt
from jaxslam.semantics.prompted.segmenter import PROMPT_ADAPTERS as PROMPT_ADAPTERS
from jaxslam.semantics.prompted.segmenter import PromptSegmenter as PromptSegmenter
from jaxslam.semantics.prompted.segmenter import Segments as Segments
from jaxslam.semantics.prompted.segmenter import load_segmenter as load_segmenter
