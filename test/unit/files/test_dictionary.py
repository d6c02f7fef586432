"""Dictionaries: names of OpenCV, our own files, and every way in which a file can be wrong."""

import cv2
import numpy as np
import pytest
from support.opencv import draw_marker
import yaml

from thermal_fiducial.core.detection.patterns import correctable_bits, Dictionary
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.dictionary import bring_from_map, load_dictionary, other_patterns, save_dictionary

NAMES = ['DICT_4X4_50', 'DICT_5X5_1000', 'DICT_6X6_250', 'DICT_7X7_50', 'DICT_APRILTAG_36h11', 'DICT_APRILTAG_16h5']


@pytest.mark.parametrize('name', NAMES)
def test_bits_are_those_that_opencv_draws(name):
    theirs = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
    bits = load_dictionary(name).bits
    cells = bits.shape[1] + 2
    for marker_id in (0, 3, len(bits) - 1):
        drawn = draw_marker(theirs, marker_id, 4 * cells)[2::4, 2::4] > 0
        np.testing.assert_array_equal(bits[marker_id], drawn[1:-1, 1:-1])


@pytest.mark.parametrize(
    ('name', 'count'), [('DICT_4X4_50', 1), ('DICT_4X4_1000', 0), ('DICT_5X5_1000', 2), ('DICT_APRILTAG_36h11', 5)]
)
def test_correctable_bits_are_those_of_the_hamming_distance(name, count):
    """As the dictionaries were published; what OpenCV says of them depends on its version."""
    dictionary = load_dictionary(name)
    assert dictionary.correctable == correctable_bits(dictionary.bits) == count


@pytest.mark.parametrize('name', NAMES)
def test_file_gives_the_same_dictionary(name, tmp_path):
    dictionary = load_dictionary(name)
    save_dictionary(tmp_path / 'own.yaml', 'OWN', dictionary)
    again = load_dictionary(tmp_path / 'own.yaml')
    np.testing.assert_array_equal(again.bits, dictionary.bits)
    assert again.correctable == dictionary.correctable


GOOD = {'format': 'thermal_fiducial/dictionary', 'version': 1, 'marker_size': 2, 'markers': [['01', '11']]}


@pytest.mark.parametrize(
    ('change', 'words'),
    [
        ({'format': 'other'}, 'not of format'),
        ({'version': 2}, 'no version 1'),
        ({'marker_size': 'two'}, "marker_size: 'two' is not a whole number"),
        ({'max_correction_bits': -1}, 'not a whole number from 0 to 4'),
        ({'markers': []}, 'no markers'),
        ({'markers': [['01', '1']]}, r'markers\[0\]: not 2 strings'),
        ({'markers': [['01', '12']]}, r'markers\[0\]: not 2 strings'),
        ({'markers': [['01', '11'], 7]}, r'markers\[1\]'),
        ({'markers': [['01', '11'], ['11', '10']]}, r'markers\[1\]: looks like marker 0, upright or turned'),
    ],
)
def test_errors_of_a_dictionary_file_name_the_fault(change, words, tmp_path):
    path = tmp_path / 'own.yaml'
    path.write_text(yaml.safe_dump(GOOD | change))
    with pytest.raises(InputError, match=words):
        load_dictionary(path)


def test_a_file_corrects_no_more_than_its_patterns_allow(tmp_path):
    """Three bits or more excuse a marker from looking like its pattern: a neighbour's would do."""
    dictionary = load_dictionary('DICT_4X4_50')
    save_dictionary(tmp_path / 'own.yaml', 'OWN', Dictionary(dictionary.bits, 6))
    assert load_dictionary(tmp_path / 'own.yaml').correctable == dictionary.correctable


@pytest.mark.parametrize('name', ['DICT_4X4_51', 'getPredefinedDictionary', '/nowhere/at/all.yaml', ''])
def test_unknown_name(name):
    with pytest.raises(InputError, match='neither'):
        load_dictionary(name)


@pytest.mark.parametrize(
    ('of', 'read_as', 'words'),
    [
        ('DICT_4X4_50', 'DICT_4X4_50', ''),
        ('DICT_4X4_50', 'DICT_4X4_250', ''),  # the first 50 are the same
        ('DICT_4X4_250', 'DICT_4X4_50', 'marker 60'),
        ('DICT_5X5_50', 'DICT_4X4_50', 'marker 3'),
        ('gone.yaml', 'DICT_4X4_50', "dictionary 'gone.yaml'"),
    ],
)
def test_a_map_of_another_dictionary_is_reported(of, read_as, words):
    reported = other_patterns([60, 3] if '250' in of else [3], of, read_as)
    assert words in reported if words else reported == ''


def test_a_file_beside_a_map_may_be_named_as_those_of_opencv_are(tmp_path):
    save_dictionary(tmp_path / 'DICT_OWN.yaml', 'DICT_OWN', load_dictionary('DICT_5X5_50'))
    assert 'marker 3 looks different' in other_patterns([3], 'DICT_OWN.yaml', 'DICT_4X4_50', tmp_path)
    assert 'did you mean DICT_4X4_50?' in other_patterns([3], 'DICT_4X4_51', 'DICT_5X5_50', tmp_path)


def test_a_map_names_a_dictionary_or_a_file_beside_it_and_opens_no_other(tmp_path):
    (tmp_path / 'maps').mkdir()
    for folder in (tmp_path, tmp_path / 'maps'):
        save_dictionary(folder / 'own.yaml', 'OWN', load_dictionary('DICT_5X5_50'))
    beside = tmp_path / 'maps'
    assert 'marker 3 looks different' in other_patterns([3], 'own.yaml', 'DICT_4X4_50', beside)
    for path in (str(tmp_path / 'own.yaml'), '../own.yaml', '/dev/zero', '/etc/passwd'):
        assert 'not opened' in other_patterns([3], path, 'DICT_4X4_50', beside)
    # The parameter is the user's own: it may be any path, and the map that is written says so.
    assert other_patterns([3], '/elsewhere/own.yaml', str(tmp_path / 'own.yaml'), beside) == ''


def test_a_run_that_is_made_anew_gets_the_dictionary_file_that_its_map_has_now(tmp_path):
    maps, run = tmp_path / 'maps', tmp_path / 'run'
    maps.mkdir()
    run.mkdir()
    for name in ('DICT_4X4_50', 'DICT_5X5_50'):
        save_dictionary(maps / 'own.yaml', 'own', load_dictionary(name))
        bring_from_map('own.yaml', maps, run, anew=True)
        assert (run / 'own.yaml').read_text() == (maps / 'own.yaml').read_text()
    save_dictionary(maps / 'own.yaml', 'own', load_dictionary('DICT_6X6_50'))
    with pytest.raises(InputError, match='not the dictionary'):
        bring_from_map('own.yaml', maps, run)
